"""`python -m ccd_casadi.tune DATA...`: the command of the extension `measured`."""

from ccd_casadi.support.extensions import command

main = command("tune")

if __name__ == "__main__":
    raise SystemExit(main())
