"""`python -m ccd_casadi.worth CASE.toml`: the command of the extension `worth`."""

from ccd_casadi.support.extensions import command

main = command("worth")

if __name__ == "__main__":
    raise SystemExit(main())
