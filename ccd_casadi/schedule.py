"""`python -m ccd_casadi.schedule CASE.toml`: the command of the extension `schedule`."""

from ccd_casadi.support.extensions import command

main = command("schedule")

if __name__ == "__main__":
    raise SystemExit(main())
