"""`python -m ccd_casadi.explore CASE.toml|RUN_DIR`: the command of the extension `explorer`."""

from ccd_casadi.support.extensions import command

main = command("explore")

if __name__ == "__main__":
    raise SystemExit(main())
