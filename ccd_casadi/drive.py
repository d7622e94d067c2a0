"""`python -m ccd_casadi.drive CASE.toml`: the command of the extension `drives`."""

from ccd_casadi.support.extensions import command

main = command("drive")

if __name__ == "__main__":
    raise SystemExit(main())
