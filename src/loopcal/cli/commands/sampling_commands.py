# SPDX-License-Identifier: Apache-2.0
"""`loopcal bootstrap` and `loopcal sample`: uncertainty beyond linear intervals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import terminal
from loopcal.cli.options import (
    Count,
    OptionGroup,
    Words,
    data_argument,
    data_options,
    file_option,
    fit_options,
    flag_option,
    force_option,
    library_option,
    make_fit_options,
    read_fitted_measurements,
    refuse_given,
    seed_option,
)
from loopcal.cli.terminal import Output, shows_output
from loopcal.errors import LoopcalError

if TYPE_CHECKING:
    from loopcal.diagnose.bootstrap import Bootstrap
    from loopcal.diagnose.intervals import Intervals
    from loopcal.diagnose.posterior_sample import PosteriorSample
    from loopcal.estimate.result import Identification
    from loopcal.measure.measurements import Measurements
    from loopcal.results.tables import Block

MOST_DIGITS = 10
"""Digits of a number of poses; a longer text is no unit of resampling."""

BOOTSTRAP = "loopcal.diagnose.bootstrap"

source_options = OptionGroup(
    click.argument("source", metavar="RUN|ROBOT"), data_argument("[DATA...]", required=False)
)
"""Decorator of a command that takes a run folder, or a robot and its measurements."""

draw_options = OptionGroup(
    library_option(
        "--level",
        of=f"{BOOTSTRAP}:Bootstrap.intervals",
        type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
        metavar="SHARE",
        help="Coverage of the intervals.",
    ),
    seed_option("the random draws"),
    file_option("-o", "--output", help="CSV file for the draws, one row each.", metavar="CSV"),
    force_option("the output file"),
)
"""Decorator of a command that draws."""


def load_fit(
    source: str, data: tuple[Path, ...], options: Mapping[str, Any]
) -> tuple[Identification, Measurements]:
    """Return a fit with its measurements, and with the uncertainty that `calibrate` states: that of
    a run folder, repeated, or of a robot file and data by `fit_options` and `data_options`.
    """
    from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
    from loopcal.estimate.identification import identify
    from loopcal.io.robot.robot_file import load_robot
    from loopcal.io.runs.run_folder import load_run, repeat_fit

    if data:
        robot = load_robot(source)
        measurements = read_fitted_measurements(data, robot, options)
        chosen = make_fit_options(options)
        with terminal.ProgressBar() as progress:
            fit = identify(robot, measurements, options=chosen, progress=progress)
    else:
        if Path(source).is_file():
            raise LoopcalError(
                f"{source}: this is a file; give a run folder, or the files of measurements after "
                "that of the robot"
            )
        refuse_given(options, "with a run folder")
        run = load_run(source)
        with terminal.ProgressBar() as progress:
            fit, measurements = repeat_fit(run, progress)
    return adjust_uncertainty(fit, measurements), measurements


@click.command()
@source_options
@library_option(
    "--count",
    of=f"{BOOTSTRAP}:bootstrap",
    type=Count("RESAMPLES", 2),
    metavar="N",
    help="Number of resamples.",
)
@library_option(
    "--scheme",
    of=f"{BOOTSTRAP}:bootstrap",
    type=Words(f"{BOOTSTRAP}:Scheme"),
    help="wild: errors of each block times a random factor. pairs: blocks drawn with replacement. "
    "normal: normal errors of the stated sigma.",
)
@click.option(
    "--unit",
    metavar="UNIT",
    help="What is resampled together: pose, block, session, day, or a number of consecutive "
    "poses.  [default: the largest unit with at least 12 blocks]",
)
@library_option(
    "--interval",
    "kind",
    of=f"{BOOTSTRAP}:Bootstrap.intervals",
    type=Words(f"{BOOTSTRAP}:IntervalKind"),
    help="How intervals are read from the resamples.",
)
@draw_options
@fit_options
@data_options
@shows_output
def bootstrap(
    source: str,
    data: tuple[Path, ...],
    count: int,
    scheme: Any,
    unit: str | None,
    kind: Any,
    level: float,
    seed: int,
    output: Path | None,
    force: bool,
    **options: Any,
) -> Output:
    """Resample a calibration by blocks of poses, fit every resample, and compare the scatter with
    the stated intervals.

    RUN is a run folder, whose fit is repeated from its files. Or give a ROBOT and DATA, and the
    options of the fit.

    \b
    Examples:
      loopcal bootstrap run
      loopcal bootstrap run --unit session --count 2000 -o draws.csv
      loopcal bootstrap hexapod-42 measurements.csv --method least-squares
    """  # noqa: D301
    from loopcal.diagnose.bootstrap import bootstrap as resample
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.report.validation_view import view_bootstrap

    refuse_outputs((output,), (Path(source), *data), force)
    fit, measurements = load_fit(source, data, options)
    is_number = unit is not None and unit.isdecimal() and len(unit) < MOST_DIGITS
    chosen = int(unit) if unit is not None and is_number else unit
    with terminal.ProgressBar() as progress:
        result = resample(
            fit, measurements, count, scheme=scheme, unit=chosen, seed=seed, progress=progress
        )
    intervals = result.intervals(level, kind)
    return _finish(result, intervals, view_bootstrap(result, intervals), output)


@click.command()
@source_options
@library_option(
    "--count",
    of="loopcal.diagnose.posterior_sample:sample_posterior",
    type=Count("DRAWS", 100),
    metavar="N",
    help="Number of draws.",
)
@flag_option(
    "--region",
    help="Instead of drawing, show linear intervals that hold for several parameters at once; "
    "of parameters that -p selects, also their joint region.",
)
@click.option(
    "-p",
    "--parameter",
    "names",
    multiple=True,
    metavar="NAME",
    help="Parameter for --region, or a pattern such as 'leg1.*'. May be given several times.  "
    "[default: all]",
)
@library_option(
    "--rule",
    of="loopcal.diagnose.intervals:compute_simultaneous_intervals",
    type=Words("loopcal.diagnose.intervals:Rule"),
    help="How --region makes intervals that hold together; maximum gives the narrowest.",
)
@draw_options
@fit_options
@data_options
@shows_output
def sample(
    source: str,
    data: tuple[Path, ...],
    count: int,
    region: bool,
    names: tuple[str, ...],
    rule: Any,
    level: float,
    seed: int,
    output: Path | None,
    force: bool,
    **options: Any,
) -> Output:
    """Draw parameters from the exact posterior of a calibration, and compare its intervals with the
    linear ones. With --region, show intervals that hold for all selected parameters at once.

    RUN is a run folder, whose fit is repeated from its files. Or give a ROBOT and DATA, and the
    options of the fit.

    \b
    Examples:
      loopcal sample run
      loopcal sample run --count 20000 -o draws.csv
      loopcal sample linear-delta measurements.csv --method map
      loopcal sample run --region -p radius -p 'tower*.angle'
    """  # noqa: D301
    from loopcal.diagnose.intervals import compute_joint_region, compute_simultaneous_intervals
    from loopcal.diagnose.posterior_sample import sample_posterior
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.runs.run_folder import load_run
    from loopcal.report.validation_view import view_posterior, view_region

    if region:
        refuse_given(("count", "seed", "output", "force"), "with --region")
        if data:
            posterior = load_fit(source, data, options)[0].posterior
        else:
            refuse_given(options, "with a run folder")
            posterior = load_run(source).load_posterior()
        together = compute_simultaneous_intervals(posterior, names or None, level, rule)
        joint = compute_joint_region(posterior, names, level) if names else None
        return Output(
            {"intervals": together.to_dict(), "region": None if joint is None else joint.to_dict()},
            lambda: view_region(joint, together, posterior.robot),
        )
    refuse_given(("names", "rule"), "without --region")
    refuse_outputs((output,), (Path(source), *data), force)
    fit, measurements = load_fit(source, data, options)
    with terminal.ProgressBar() as progress:
        result = sample_posterior(fit, measurements, count, seed=seed, progress=progress)
    intervals = result.intervals(level)
    return _finish(result, intervals, view_posterior(result, intervals), output)


def _finish(
    result: Bootstrap | PosteriorSample,
    intervals: Intervals,
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
