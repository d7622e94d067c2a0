"""`python -m ccd_casadi.feedforward RUN_DIR`: the command of the extension `feedforward`."""

from ccd_casadi.support.extensions import command

main = command("feedforward")

if __name__ == "__main__":
    raise SystemExit(main())
