"""`python -m surrogates.retrain RUN_DIR`: the command `ccd retrain`, by the name that scripts use.

The one module here that knows of control; nothing of the package imports it.
"""

from ccd_casadi.support.errors import exit_on_ctrl_c

if __name__ == "__main__":
    exit_on_ctrl_c()

from ccd_casadi.retrain import main

if __name__ == "__main__":
    raise SystemExit(main())
