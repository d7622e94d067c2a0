"""Time series of a machine, in open or closed loop, and the plant's frequency response of them.

`python -m ccd_casadi.record LOG...`: a plant's response from records of its loop.
"""

import argparse
import sys
from dataclasses import replace
from io import BytesIO, StringIO
from typing import TYPE_CHECKING

from ccd_casadi.support.command_line import RUN, ExitCode, command, run_folder
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import option, positive, real, take_value
from ccd_casadi.support.terminal import inform

if TYPE_CHECKING:
    from ccd_casadi.extensions.records.plant_estimate import EstimateOptions
    from ccd_casadi.extensions.records.time_series import SignalNames


EXTENSION = Extension(
    commands={
        "record": (
            "ccd_casadi.extensions.records",
            "estimate a plant's response from records of its loop",
        )
    }
)


@command(
    "ccd_casadi.record", "Estimate a plant's response from records of its loop, for ccd tune.",
    option("--injected", metavar="NAME", help="column of the force that is injected"),
    option("--reference", metavar="NAME", help="column of the reference, where that excites"),
    option("--force", metavar="NAME[,NAME]",
           help="column of the plant's whole force, by the controller; of several, a LOG each"),
    option("--position", metavar="NAME[,NAME]", help="column of the position, or of several"),
    option("--time", metavar="NAME", help="column of the time"),
    option("--open-loop", action="store_true", help="the force is the excitation"),
    option("--add-injected", action="store_true",
           help="the column of the force has the controller's alone, without what is injected"),
    option("--rate-hz", metavar="X", type=positive, help="sampling rate, without a time column"),
    take_value("--confidence", "X", real(0.5, 0.9999), "of the spread, at each line", 0.95),
    take_value("--gain", "X", positive, "factor on the response, where units are not m and N", 1.0),
    option("--rotary", action="store_true", help="the position is in rad, the force in N m"),
    needs=["ccd_casadi.extensions.records.plant_estimate",
           "ccd_casadi.extensions.records.record_findings"],
    place=RUN | {"metavar": "LOG", "nargs": "+", "help": "records (.csv, .npz, .mat, .tdms, "
                 ".wav) of one loop; channels of WAV are named 1, 2, ..."},
    without_effect=["--workers", "--seed", "--no-user-code"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Estimate, print a table, write response.npz, response.csv and response.png."""
    import numpy as np

    from ccd_casadi.extensions.records.plant_estimate import EstimateOptions, estimate_plant
    from ccd_casadi.extensions.records.record_findings import findings, record_picture
    from ccd_casadi.extensions.records.time_series import SignalNames, read_record
    from ccd_casadi.support.text import use_units
    from surrogates.files import write_whole

    use_units(*(("rad", "N m") if options.rotary else ("m", "N")))
    names = SignalNames(
        options.injected, options.reference, options.force, options.position, options.time,
        options.rate_hz, options.open_loop, options.add_injected,
    )  # fmt: skip
    how = EstimateOptions(confidence=options.confidence)
    if "," in (options.force or "") + (options.position or ""):
        return _several(options, names, how)
    records = [read_record(path, names) for path in options.run]
    for path, one in zip(options.run, records, strict=True):
        inform(f"{path.name}: {one.words}", sys.stderr)
    try:
        found = estimate_plant(records, how)
    except UserError as error:
        raise UserError(f"{options.run[0]}: {error}") from None
    found = replace(found, G=options.gain * found.G, spread=options.gain * found.spread)
    rows = findings(found, records[0].period, how)
    used = found.used
    if records[0].injected and not options.add_injected and found.through < how.through:
        raise UserError(
            f"{options.run[0]}: what is injected appears in the force by a factor "
            f"{found.through:.2g}: the force may be the controller's alone (state --add-injected) "
            "or another column the plant's (state --force)"
        )
    folder = run_folder(options.run[0], options.out)
    write_whole(folder / "response.png", record_picture(found, how.confidence))
    if not len(used.hz):
        raise UserError(f"{options.run[0]}: {rows[0][1]}")
    stream, text = BytesIO(), StringIO()
    np.savez(stream, f_hz=used.hz, G=used.G, spread=used.spread, coherence=used.coherence)
    table = np.column_stack([used.hz, used.G.real, used.G.imag, used.spread, used.coherence])
    text.write(f"# confidence of spread: {100.0 * how.confidence:g} % at each line\n")
    np.savetxt(text, table, fmt="%.9g", delimiter=",", header="f_hz,re,im,spread,coherence",
               comments="")  # fmt: skip
    write_whole(folder / "response.npz", stream.getvalue())
    write_whole(folder / "response.csv", text.getvalue())
    rate = 1.0 / records[0].period
    rows += [("picture", str(folder / "response.png")),
             ("next", f"ccd tune {folder / 'response.npz'} --rate-hz {rate:.6g}")]  # fmt: skip
    inform("\n".join(f"{name:14s}{words}" for name, words in rows))
    return ExitCode.DONE


def _several(options: argparse.Namespace, names: "SignalNames", how: "EstimateOptions") -> ExitCode:
    """The same of several forces and positions, without a picture."""
    import numpy as np

    from ccd_casadi.extensions.records.plant_estimate import (
        channel_findings,
        estimate_channels,
        read_channels,
    )
    from surrogates.files import write_whole

    if options.force is None or options.position is None:
        raise UserError("--force, --position: of several channels state both, apart by commas")
    own = [[name.strip() for name in text.split(",")] for text in (options.force, options.position)]
    excited = (options.injected or options.reference or "").split(",")
    if len(excited) not in (1, len(options.run)):
        raise UserError(f"--injected: names {len(excited)} columns; state one, or one a LOG")
    excited = excited * (len(options.run) // len(excited))
    injected, none = not options.reference, [None] * len(options.run)
    columns = [name or None for name in excited]
    each = [replace(names, injected=one, reference=other) for one, other in
            zip(*((columns, none) if injected else (none, columns)), strict=True)]  # fmt: skip
    records = [read_channels(path, one, *own) for path, one in zip(options.run, each, strict=True)]
    for path, record in zip(options.run, records, strict=True):
        inform(f"{path.name}: {record[0][0].words}", sys.stderr)
    found = estimate_channels(records, how)
    folder, stream = run_folder(options.run[0], options.out), BytesIO()
    np.savez(stream, f_hz=found.hz, G=options.gain * found.G, spread=options.gain * found.spread,
             coherence=found.coherence)  # fmt: skip
    write_whole(folder / "response.npz", stream.getvalue())
    rate = 1.0 / records[0][0][0].period
    ahead = f"ccd tune {folder / 'response.npz'} --rate-hz {rate:.6g}"
    rows = [*channel_findings(found, how), ("next", ahead)]
    inform("\n".join(f"{name:14s}{words}" for name, words in rows))
    return ExitCode.DONE
