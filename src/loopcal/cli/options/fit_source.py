# SPDX-License-Identifier: Apache-2.0
"""The fit that a command examines further: that of a run folder, repeated, or a new one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from loopcal.cli import terminal
from loopcal.cli.options.fit_options import make_fit_options
from loopcal.cli.options.shared_options import (
    leave_out_held_out,
    read_checked_measurements,
    refuse_given,
    take_flags,
)
from loopcal.errors import EstimationError, LoopcalError
from loopcal.findings import report_finding

if TYPE_CHECKING:
    from loopcal.estimate import Identification
    from loopcal.io import Run
    from loopcal.measure import Measurements

EQUAL = 1e-2
"""Largest difference of a repeated estimate from that of the run, in standard deviations."""


def load_fit(
    source: str, data: Sequence[Path], options: Mapping[str, Any]
) -> tuple[Identification, Measurements]:
    """Return a fit with its measurements, and with the uncertainty that `calibrate` states.

    Parameters
    ----------
    source : a run folder, or with `data` a robot file. options : those of `fit_options` and
        `data_options`.

    Raises
    ------
    LoopcalError : see `loopcal.identify` and `Run.load_measurements`; or the run cannot be
        repeated.
    """
    from loopcal.diagnose import adjust_uncertainty
    from loopcal.estimate import identify
    from loopcal.io import load_robot, load_run

    if data:
        robot = load_robot(source)
        flags = take_flags(options)
        measurements = leave_out_held_out(read_checked_measurements(data, robot, **flags))
        with terminal.ProgressBar() as progress:
            fit = identify(
                robot, measurements, options=make_fit_options(options), progress=progress
            )
    else:
        if Path(source).is_file():
            raise LoopcalError(
                f"{source}: this is a file; give a run folder, or the files of measurements after "
                "that of the robot"
            )
        refuse_given(options, "with a run folder")
        fit, measurements = _repeat_run(load_run(source))
    return adjust_uncertainty(fit, measurements), measurements


def _repeat_run(run: Run) -> tuple[Identification, Measurements]:
    """Return the fit of a run, made again from its files and the options of its command line."""
    from dataclasses import replace

    from loopcal.estimate import FitOptions, identify, recalibrate
    from loopcal.io import load_run

    stated = _read_options(run)
    accepted = ("allow_outside_stroke", "allow_duplicates")
    data, _ = run.load_measurements(**{name: bool(stated.get(name)) for name in accepted})
    options = make_fit_options(stated) if stated else FitOptions()
    options = replace(options, excluded_poses=())  # they are no longer among the measurements
    with terminal.ProgressBar() as progress:
        if stated.get("prior") is not None:
            earlier, limb = load_run(stated["prior"]).load_posterior(), stated.get("free_limb")
            fit, _ = recalibrate(
                run.initial_robot, data, earlier, limb, options=options, progress=progress
            )
        else:
            fit = identify(run.initial_robot, data, options=options, progress=progress)
    estimate, sd = run.arrays["estimate"], fit.standard_deviations
    if len(estimate) != len(sd):
        raise EstimationError(report_finding("sampling.run-not-repeated", run=str(run.path)))
    off = np.abs(fit.estimate - estimate) > EQUAL * np.where(np.isfinite(sd), sd, np.inf)
    if off.any():
        raise EstimationError(report_finding("sampling.run-not-repeated", run=str(run.path)))
    return fit, data


def _read_options(run: Run) -> dict[str, Any]:
    """Return the options of the command `calibrate` that made a run; none for a run of Python."""
    from loopcal.cli.commands.calibration_commands import calibrate

    words: list[str] = list((run.result.get("made_by") or {}).get("command") or ())
    if "calibrate" not in words:
        return {}
    given = words[words.index("calibrate") + 1 :]
    context: click.Context = calibrate.make_context("calibrate", given, resilient_parsing=True)
    return context.params
