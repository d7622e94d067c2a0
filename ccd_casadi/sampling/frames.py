"""What a run has computed, as a table of pandas."""

from dataclasses import asdict
from typing import TYPE_CHECKING

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.units import problem_hash
from ccd_casadi.support.errors import require
from ccd_casadi.support.text import HZ

if TYPE_CHECKING:
    import pandas

_RATES = ("omega_S", "omega_T", "bandwidth", "sensitivity_peak_frequency")  # stored in rad/s
_LEFT_OUT = ("key", "theta", "gradients")


def samples_frame(run: FinishedRun) -> "pandas.DataFrame":
    """Every true synthesis of a run, one row each: θ in SI under its names, then the figures.

    Frequencies end in `_hz`; a figure is NaN where a synthesis ended before it was known, and
    `certified` and `reason` say which rows are designs. Of a fixed structure a row is the best
    design at its θ.

    Parameters
    ----------
    run : FinishedRun
        As `read_run` gives it.

    Returns
    -------
    pandas.DataFrame

    Raises
    ------
    MissingPackage
        pandas is not installed.
    UserError
        The folder has no usable samples.sqlite.
    """
    pandas = require("pandas", "notebook")
    with SampleStore(run.folder / "samples.sqlite") as store:
        samples = store.select(problem_hash(run.problem.identity()))
    rows = []
    for sample in samples:
        row = dict(zip(run.problem.names, sample.theta, strict=True))
        for name, value in asdict(sample).items():
            if name in _RATES:
                row[f"{name}_hz"] = value / HZ
            elif name not in _LEFT_OUT:
                row[name] = value
        rows.append(row)
    return pandas.DataFrame(rows)
