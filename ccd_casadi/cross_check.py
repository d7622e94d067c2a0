"""`python -m ccd_casadi.cross_check CASE.toml`: the command of the extension `cross_check`."""

from ccd_casadi.support.extensions import command

main = command("cross_check")

if __name__ == "__main__":
    raise SystemExit(main())
