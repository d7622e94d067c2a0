"""`python -m ccd_casadi.deploy RUN_DIR`: the run's controller as one that can be built."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccd_casadi.deployment import Timing
from ccd_casadi.robust import MOVE_OPTIONS, move_of
from ccd_casadi.support import extensions
from ccd_casadi.support.command_line import RUN, ExitCode, command, run_folder
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import one_line, option, positive, real, take_value
from ccd_casadi.support.terminal import Progress, inform, say
from ccd_casadi.support.text import spoken, with_unit

if TYPE_CHECKING:  # what computes is imported once the options are known to be right
    from ccd_casadi.cases.run_folder import FinishedRun
    from ccd_casadi.deployment.on_hardware import OnHardware
    from ccd_casadi.deployment.outcome import Deployment
    from ccd_casadi.lti.loop import Sampling


def _delay(arguments: argparse.ArgumentParser) -> None:
    """Add --delay and --delay-samples."""
    either = arguments.add_mutually_exclusive_group()
    words = "time from reading y to the new u, in s"
    either.add_argument("--delay", metavar="SECONDS", type=real(), help=words)
    words = "the same time in sampling periods (default: 1)"
    either.add_argument(
        "--delay-samples", metavar="X", type=real(), default=Timing.delay_samples, help=words
    )


@command(
    "ccd_casadi.deploy",
    "Reduce, discretise and verify a run's controller, and write it as C, JSON and .mat.",
    option("--rate-hz", metavar="X", type=positive,
           help="sampling rate (default: the next round rate above what is needed)"),
    _delay,
    option("--lead", choices=["on", "off"], default="on",
           help="a lead that compensates hold and delay (default: on, which lowers the rate)"),
    option("--unverified", action="store_true",
           help="deploy a run that is not verified; the result is not verified either"),
    option("--saturation", metavar="NEWTON", type=positive,
           help="limit every u to plus or minus this, with anti-windup (default: off)"),
    option("--single", action="store_true",
           help="C code in single precision (float), whose rounded coefficients are judged; no "
           "structured text"),
    option("--fixed", type=int, choices=[16, 32], metavar="BITS",
           help="C code in integers of 16 or 32 bits, saturating, whose rounded coefficients are "
           "judged; no structured text. A count of e or u is --sensor-step or --force-step, where "
           "given"),
    option("--fmu", action="store_true",
           help="also write controller.fmu (FMI 2.0, co-simulation), compiled by cc or what CC "
           "names"),
    take_value("--sensor-step", "METRE", real(), "of the simulated sensor", 0.0),
    take_value("--force-step", "NEWTON", real(), "of the simulated actuator", 0.0),
    take_value("--jitter", "SECONDS", real(),
           "of the simulated delay, uniform within plus or minus this", 0.0),
    *MOVE_OPTIONS, needs=["ccd_casadi.deployment.pipeline"], place=RUN,
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Deploy, write the folder, print a summary."""
    _require_one_precision(options)
    from ccd_casadi.cases.run_folder import read_run
    from ccd_casadi.codesign.result import with_verdict_line
    from ccd_casadi.deployment.deploy_files import write_files
    from ccd_casadi.deployment.outcome import DeployedRun

    run = read_run(options.run, of_share=True)
    status = run.result.get("status")
    if status != "verified" and not options.unverified:
        reason = run.result.get("reason") or "no reason is given"
        words = f"the run is {status}: {reason}"
        remedy = "solve it again, or give --unverified to deploy it nevertheless"
        say(one_line(f"{options.run}: {words}; {remedy}"), sys.stderr)
        return ExitCode.NOT_VERIFIED
    folder = run_folder(options.run, options.out or options.run / "deploy")
    if folder.resolve() == options.run.resolve():
        words = "would overwrite the run's own controller and report"
        raise UserError(f"--out {folder}: {words}; choose another folder")
    found, moved = _deploy(run, options)
    _remove_earlier(folder)
    write_files(folder, run, found, options.seed, moved)
    if moved is not None:
        _write_code(folder, run, found, moved, options)
    line = DeployedRun(run, found).check(moved)
    run = with_verdict_line(run, folder, line)
    # a folder elsewhere leaves the run as it is, but the decision here is on what was deployed
    verdict = run.result.get("verdict")
    known = {"verdict": {**verdict, line.name: line.entry}} if isinstance(verdict, dict) else {}
    inform(_summary(run, found, moved, {**run.result, **known}))
    from ccd_casadi.reporting.deploy_page import deploy_page  # matplotlib is slow to import
    from ccd_casadi.reporting.moves import way_words
    from ccd_casadi.reporting.run_verdict import index_of, publish

    if moved is not None:
        last = list(moved.ways)[-1]
        far = with_unit(moved.ways[last].position[-1], spoken("m"))
        inform(f"{'a move':13s} of {far} on the model, {way_words(last, [moved.ways[last]])}")
    page = deploy_page(run, found, moved, index_of(folder))
    publish(run.folder, folder / "report.html", page)
    inform(f"page          {folder / 'report.html'}")
    if found.passed:
        return ExitCode.DONE
    say(one_line(f"not verified: {shortfall_words(found)}"), sys.stderr)
    return ExitCode.NOT_VERIFIED


def _require_one_precision(options: argparse.Namespace) -> None:
    """Raise UserError where options want code of two precisions, or an FMU that nothing writes."""
    if options.fmu and extensions.function("fmu") is None:
        raise UserError(extensions.missing("--fmu", "functions", "fmu"))
    if options.single and options.fixed:
        raise UserError("--single, --fixed: the code has one precision; drop one of them")
    if options.fmu and (options.single or options.fixed):
        raise UserError("--fmu: is of double precision; drop it, or --single, --fixed")


def _deploy(
    run: "FinishedRun", options: argparse.Namespace
) -> tuple["Deployment", "OnHardware | None"]:
    """Deploy a run's controller, and simulate its move where the loop is stable."""
    from ccd_casadi.deployment.fixed_point import FixedRequest
    from ccd_casadi.deployment.integer_loop import integer_faults
    from ccd_casadi.deployment.on_hardware import Electronics, on_hardware
    from ccd_casadi.deployment.pipeline import deploy
    from ccd_casadi.inner_problem.kinds import kind_of

    timing = Timing(options.rate_hz, options.delay, options.delay_samples, options.lead == "on")
    electronics = Electronics(options.sensor_step, options.force_step, options.jitter, options.seed)
    designed, kind = run.problem.sampling, kind_of(run.problem)
    rate_hz = options.rate_hz or (designed.rate_hz if designed else None)
    if rate_hz is not None:  # else the rate is chosen first
        electronics.require_in_order(1.0 / rate_hz)
    channels = len(run.plant.C) if run.plant.channels else 1
    steps = (0 if kind.as_designed else channels) + 2 + (options.saturation is not None)
    moved, fixed, (limits, window) = None, None, move_of(options, run)
    if options.fixed:
        fixed = FixedRequest(options.fixed, limits, options.sensor_step, options.force_step)
    with Progress(steps, "deploying") as bar:
        found = deploy(
            run, timing, saturation=options.saturation, single=options.single, fixed=fixed,
            progress=lambda words: bar.advance(note=words),
        )  # fmt: skip
        if found.stable:
            moved = on_hardware(
                run.loop.plant, found.realisation, found.delay, run.bandwidth, limits=limits,
                window=window, hardware=electronics, places=kind.bounds().places,
                ports=run.loop.ports if run.loop.ported else None,
                progress=lambda words: bar.advance(note=words),
            )  # fmt: skip
    return replace(found, integer_faults=integer_faults(found.rounding, moved)), moved


def _remove_earlier(folder: Path) -> None:
    """Remove what an earlier deployment wrote: its controller must not pass for this one."""
    from ccd_casadi.deployment import source_code
    from ccd_casadi.deployment.deploy_files import DESIGN_FILES

    formats = source_code.ST_FILE, source_code.XML_FILE, source_code.FMU_FILE
    for name in (*DESIGN_FILES, *source_code.C_FILES, *formats):
        (folder / name).unlink(missing_ok=True)


def _write_code(
    folder: Path,
    run: "FinishedRun",
    found: "Deployment",
    moved: "OnHardware",
    options: argparse.Namespace,
) -> None:
    """Write the controller as C, and as structured text and an FMU where extensions make them."""
    from ccd_casadi.deployment import source_code
    from ccd_casadi.inner_problem.kinds import kind_of
    from ccd_casadi.reporting.facts import run_name

    structured_text, plcopen_xml = map(extensions.function, ("structured_text", "plcopen_xml"))
    K, name = found.realisation, run_name(options.run)
    naming: dict[str, Any] = {"title": name, "delay": found.delay, "verified": found.passed,
                              "kind": kind_of(run.problem).title}  # fmt: skip
    texts = source_code.write_c(folder, K, **naming, forward=moved.forward)
    if structured_text is not None and K.precision == "double":
        code = structured_text(K, **naming)
        (folder / source_code.ST_FILE).write_text(code, "utf-8")
        if plcopen_xml is not None:
            (folder / source_code.XML_FILE).write_text(plcopen_xml(code, name), "utf-8")
    write_fmu = extensions.function("fmu") if options.fmu else None
    if write_fmu and not write_fmu(folder / source_code.FMU_FILE, K, texts, name):
        say("note: no C compiler here (cc, or CC): the FMU has its sources alone", sys.stderr)


def _summary(
    run: "FinishedRun", found: "Deployment", moved: "OnHardware | None", judged: dict[str, Any]
) -> str:
    from ccd_casadi.deployment.integer_loop import integer_words
    from ccd_casadi.deployment.outcome import DeployedRun
    from ccd_casadi.deployment.robust_set import place_words
    from ccd_casadi.reporting.decision import decide
    from ccd_casadi.support.text import template

    deployed = DeployedRun(run, found)
    return template("templates/deploy.txt", place_words=place_words).render(
        d=found, status=deployed.status, decision=decide(judged),
        needed=needed_words(found), order=deployed.order, figures=deployed.rows,
        integers=integer_words(found.realisation.fixed, found.rounding, moved),
    ).rstrip()  # fmt: skip


def needed_words(found: "Deployment") -> str:
    """Describe what the loop was designed for, or the least rate that it needs."""
    if found.designed_for is not None:
        return f"designed for {_own(found.designed_for)}"
    if found.needed_hz is None:
        return "no rate will do"
    return f"needed {found.needed_hz:.5g} Hz"


def shortfall_words(found: "Deployment") -> str:
    """Describe what is not kept, why, and what to change."""
    if not found.shortfalls:
        return f"the run itself is not: {found.unverified}"
    missed, needed = found.shortfalls[0], found.needed_hz
    if found.designed_for is not None:
        at = f"at {found.rate_hz:.6g} Hz with a delay of {1e6 * found.delay:.4g} us"
        return f"{at}: {missed}; {_of_design(found, found.designed_for)}"
    rate = f"{found.rate_hz:.6g} Hz with {found.conversion.value}"
    if needed is None:
        return f"{rate} is not enough: {missed}; with this delay no rate is; shorten the delay"
    if found.rate_hz < needed:
        return f"{rate} is not enough: {missed}; {needed:.6g} Hz is needed"
    # the plants of the case's set allow this rate; one between them, or the judge, does not
    return f"{rate}: {missed}; leave out --rate-hz, or give one above {found.rate_hz:.6g} Hz"


def _own(designed: "Sampling") -> str:
    return f"{designed.rate_hz:.6g} Hz and {designed.delay_us:.4g} us"


def _of_design(found: "Deployment", designed: "Sampling", *, same: float = 1e-9) -> str:
    """How the loop runs otherwise than it was designed to, and the remedy of that; rates and delays
    that differ by a share of `same` are the same."""
    more, causes, keys = 1.0 + same, [], []
    if found.rate_hz * more < designed.rate_hz:
        causes.append(f"the rate is below the {designed.rate_hz:.6g} Hz")
        keys.append(f"loop.rate_hz = {found.rate_hz:.6g}")
    if found.delay > more * designed.delay:
        causes.append(f"the delay exceeds the {designed.delay_us:.4g} us")
        keys.append(f"loop.delay_us = {1e6 * found.delay:.4g}")
    if causes:
        why, write = " and ".join(causes), " and ".join(keys)
        return f"{why} of the design: keep to the design, or write {write} in the case and solve it"
    if found.rate_hz <= more * designed.rate_hz and more * found.delay >= designed.delay:
        return "the loop runs as it was designed: solve the case again"
    return f"it was designed for {_own(designed)}: keep to these"


if __name__ == "__main__":
    raise SystemExit(main())
