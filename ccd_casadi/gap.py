"""`python -m ccd_casadi.gap CASE.toml`: the command of the extension `limitations`."""

from ccd_casadi.support.extensions import command

main = command("gap")

if __name__ == "__main__":
    raise SystemExit(main())
