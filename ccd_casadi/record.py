"""`python -m ccd_casadi.record LOG...`: the command of the extension `records`."""

from ccd_casadi.support.extensions import command

main = command("record")

if __name__ == "__main__":
    raise SystemExit(main())
