# SPDX-License-Identifier: Apache-2.0
"""`loopcal bootstrap` and `loopcal sample`: uncertainty beyond linear intervals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.terminal import Output
from loopcal.errors import LoopcalError

if TYPE_CHECKING:
    from loopcal.results.tables import Block

MOST_DIGITS = 10
"""Digits of a number of poses; a longer text is no unit of resampling."""

BOOTSTRAP = "loopcal.diagnose.bootstrap"

SOURCE: Any = opt.argument("RUN|ROBOT")
LEVEL: Any = opt.option(
    "Coverage of the intervals.", of=f"{BOOTSTRAP}:Bootstrap.intervals", type=opt.OPEN_SHARE
)
FIT_NAMES = (*opt.FIT.members, *opt.ALLOWED.members)
DRAWS: Any = opt.path("CSV file for the draws, one row each.", "-o", metavar="CSV")


def load_fit(
    source: str, data: tuple[Path, ...], options: lc.FitOptions, allowed: Mapping[str, bool]
) -> tuple[lc.Identification, lc.Measurements]:
    """Return a fit with its measurements, and with the uncertainty that `calibrate` states: that of
    a run folder, repeated, or of a robot file and data by `fit_options` and `data_options`.
    """
    from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
    from loopcal.io.runs.run_folder import repeat_fit

    if data:
        robot = lc.load_robot(source)
        measurements = opt.read_fitted_measurements(data, robot, allowed)
        with terminal.TerminalProgress() as progress:
            fit = lc.identify(robot, measurements, options=options, progress=progress)
    else:
        if Path(source).is_file():
            raise LoopcalError(
                f"{source}: this is a file. Give a run folder, or a robot file and then files of "
                "measurements"
            )
        opt.refuse_given(FIT_NAMES, "with a run folder")
        run = lc.load_run(source)
        with terminal.TerminalProgress() as progress:
            fit, measurements = repeat_fit(run, progress)
    return adjust_uncertainty(fit, measurements), measurements


@opt.command()
def bootstrap(
    source: str = SOURCE,
    data: tuple[Path, ...] = opt.data("[DATA...]", required=False),
    count: int = opt.option(
        "Number of resamples.", of=f"{BOOTSTRAP}:bootstrap", type=opt.Count("RESAMPLES", 2)
    ),
    scheme: Any = opt.option(
        "wild: errors of each block times a random factor. pairs: blocks drawn with replacement. "
        "normal: normal errors of the stated sigma.",
        of=f"{BOOTSTRAP}:bootstrap",
        type=opt.Words(f"{BOOTSTRAP}:Scheme"),
    ),
    unit: str | None = opt.option(
        "Unit of resampling: pose, block, session, day, or a number of consecutive poses.  "
        "[default: the largest unit with at least 12 blocks]",
        metavar="UNIT",
    ),
    kind: Any = opt.option(
        "Kind of the bootstrap intervals.",
        "--interval",
        of=f"{BOOTSTRAP}:Bootstrap.intervals",
        type=opt.Words(f"{BOOTSTRAP}:IntervalKind"),
    ),
    level: float = LEVEL,
    seed: int = opt.seed("the random draws", f"{BOOTSTRAP}:bootstrap"),
    output: Path | None = DRAWS,
    force: bool = opt.force("the output file"),
    fit_options: lc.FitOptions = opt.FIT,
    allowed: dict[str, bool] = opt.ALLOWED,
) -> Output:
    """Resample a calibration by blocks of poses, fit every resample, and compare the scatter with
    the intervals of the fit.

    RUN is a run folder, and the command repeats its fit. Or give a ROBOT and DATA, and the options
    of the fit.

    Examples:
      loopcal bootstrap run
      loopcal bootstrap run --unit session --count 2000 -o draws.csv
      loopcal bootstrap hexapod-42 measurements.csv --method least-squares
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.report.validation_view import view_bootstrap

    refuse_outputs((output,), (Path(source), *data), force)
    fit, measurements = load_fit(source, data, fit_options, allowed)
    is_number = unit is not None and unit.isdecimal() and len(unit) < MOST_DIGITS
    chosen = int(unit) if unit is not None and is_number else unit
    with terminal.TerminalProgress() as progress:
        result = lc.bootstrap(
            fit, measurements, count, scheme=scheme, unit=chosen, seed=seed, progress=progress
        )
    intervals = result.intervals(level, kind)
    return _finish(result, intervals, view_bootstrap(result, intervals), output)


@opt.command()
def sample(
    source: str = SOURCE,
    data: tuple[Path, ...] = opt.data("[DATA...]", required=False),
    count: int = opt.option(
        "Number of draws.",
        of="loopcal.diagnose.posterior_sample:sample_posterior",
        type=opt.Count("DRAWS", 100),
    ),
    region: bool = opt.flag(
        "Instead of drawing, show linear intervals that hold for several parameters at once, and "
        "the joint region of parameters selected by -p."
    ),
    names: tuple[str, ...] = opt.option(
        "Parameter for --region, or a pattern such as 'leg1.*'. Repeatable.  [default: all]",
        "-p",
        "--parameter",
        multiple=True,
        metavar="NAME",
    ),
    rule: Any = opt.option(
        "How --region makes intervals that hold together. maximum gives the narrowest.",
        of="loopcal.diagnose.intervals:compute_simultaneous_intervals",
        type=opt.Words("loopcal.diagnose.intervals:Rule"),
    ),
    level: float = LEVEL,
    seed: int = opt.seed("the random draws", "loopcal.diagnose.posterior_sample:sample_posterior"),
    output: Path | None = DRAWS,
    force: bool = opt.force("the output file"),
    fit_options: lc.FitOptions = opt.FIT,
    allowed: dict[str, bool] = opt.ALLOWED,
) -> Output:
    """Draw parameters from the exact posterior of a calibration, and compare its intervals with the
    linear ones. With --region, show intervals that hold for all selected parameters at once.

    RUN is a run folder, and the command repeats its fit. Or give a ROBOT and DATA, and the options
    of the fit.

    Examples:
      loopcal sample run
      loopcal sample run --count 20000 -o draws.csv
      loopcal sample linear-delta measurements.csv --method map
      loopcal sample run --region -p radius -p 'tower*.angle'
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.report.validation_view import view_posterior, view_region

    if region:
        opt.refuse_given(("count", "seed", "output", "force"), "with --region")
        if data:
            posterior = load_fit(source, data, fit_options, allowed)[0].posterior
        else:
            opt.refuse_given(FIT_NAMES, "with a run folder")
            posterior = lc.load_run(source).load_posterior()
        together = lc.compute_simultaneous_intervals(posterior, names or None, level, rule)
        joint = lc.compute_joint_region(posterior, names, level) if names else None
        return Output(
            {"intervals": together.to_dict(), "region": None if joint is None else joint.to_dict()},
            lambda: view_region(joint, together, posterior.robot),
        )
    opt.refuse_given(("names", "rule"), "without --region")
    refuse_outputs((output,), (Path(source), *data), force)
    fit, measurements = load_fit(source, data, fit_options, allowed)
    with terminal.TerminalProgress() as progress:
        result = lc.sample_posterior(fit, measurements, count, seed=seed, progress=progress)
    intervals = result.intervals(level)
    return _finish(result, intervals, view_posterior(result, intervals), output)


def _finish(
    result: lc.Bootstrap | lc.PosteriorSample,
    intervals: lc.Intervals,
    page: list[Block],
    output: Path | None,
) -> Output:
    """Write the draws, where a file is named, and return what to print."""
    from loopcal.io.core.text_file import write_text
    from loopcal.io.runs.result_files import format_draws

    if output is not None:
        factors, units = result.fit.free_parameters.display()
        weight = getattr(result, "weight", None)
        names, draws = result.fit.names, result.draws
        write_text(output, format_draws(names, units, factors, draws, weight))
        page = [*page, "", f"Written to {output}"]
    return Output({**result.to_dict(), "intervals": intervals.to_dict()}, lambda: page)
