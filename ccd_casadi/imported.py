"""`python -m ccd_casadi.imported FOLDER`: the command of the extension `imported`."""

from ccd_casadi.support.extensions import command

main = command("imported")

if __name__ == "__main__":
    raise SystemExit(main())
