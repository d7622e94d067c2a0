"""`python -m ccd_casadi.tolerances PLACE`: the command of the extension `tolerances`."""

from ccd_casadi.support.extensions import command

main = command("tolerances")

if __name__ == "__main__":
    raise SystemExit(main())
