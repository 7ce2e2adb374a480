# SPDX-License-Identifier: Apache-2.0
"""`loopcal calibrate`: identify a robot from measurements, prove it on held-out poses, keep it in a
run folder.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import show
from loopcal.cli.fitting import Fitting, fit_options
from loopcal.cli.options import (
    FILE,
    data_argument,
    data_options,
    gate_options,
    json_option,
    measurements,
    robot_argument,
)
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.apply import Validation
    from loopcal.diagnose import FitExamination
    from loopcal.estimate import Identification
    from loopcal.measure import Measurements

GREW = 1.1
"""Times by which errors on unseen poses are said to have grown: less is the noise of those poses.
"""


@click.command(short_help="Identify a robot's parameters from measurements.")
@robot_argument
@data_argument
@click.option("-o", "--output", required=True, type=FILE, help="The run folder to make.")
@click.option("--hold-out", type=click.FloatRange(0, 1, max_open=True), default=0.0, metavar="SHARE",
              help="Share of the poses to keep from the fit and to judge it by, such as 0.25.")  # fmt: skip
@fit_options
@click.option(
    "--prior",
    type=FILE,
    metavar="RUN",
    help="An earlier run on this machine; what it knew is kept.",
)
@click.option(
    "--free-limb",
    metavar="LIMB",
    help="With --prior: a limb that was repaired, such as leg3, starts anew.",
)
@gate_options
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Seed of the held-out choice.",
)
@data_options
@click.option("--force", is_flag=True, help="Replace a run that is there.")
@json_option
def calibrate(
    robot: str,
    data: tuple[Path, ...],
    output: Path,
    hold_out: float,
    fitting: Fitting,
    prior: Path | None,
    free_limb: str | None,
    limit_position: float | None,
    limit_angle: float | None,
    seed: int,
    allowed: Mapping[str, bool],
    force: bool,
    as_json: bool,
) -> int:
    """Identify the free parameters of ROBOT from DATA and write a run folder with the corrected
    robot file.

    DATA may be several files, joined by the names of poses. The exit code is 2 where a quality gate
    is not met, the iteration did not converge, the residual does not fit the stated noise, or
    errors on unseen poses grew; the run folder is written.

    \b
    Examples:
      loopcal calibrate hexapod-42 measurements.csv -o run --hold-out 0.25
      loopcal calibrate robot.yaml data.csv -o run --hold-out 0.25 --limit-position 0.02mm
      --limit-angle 0.01deg loopcal calibrate printer.yaml heights.csv -o run --noise estimated
      loopcal calibrate robot.yaml poses.csv tracker.csv inclinometer.csv -o run loopcal calibrate
      hexapod-42 after-repair.csv -o run2 --prior run --free-limb leg3
    """  # noqa: D301
    from loopcal.diagnose import check_start_values
    from loopcal.estimate.recalibration import recalibrate
    from loopcal.io import load_robot
    from loopcal.io.runs.calibration_run import load_prior, save_calibration
    from loopcal.io.runs.run_folder import collect_provenance, refuse_run_folder

    planned = _held_out(data, hold_out)
    _refuse_contradictions(
        hold_out > 0 or bool(planned),
        limit_position is not None or limit_angle is not None,
        prior,
        free_limb,
    )
    inputs, machine = _inputs(robot, data, prior), load_robot(robot)
    refuse_run_folder(output, list(inputs.values()), force)
    measured = measurements(data, machine, **allowed)
    fitted, unseen = fitting.split(measured, hold_out, seed, planned)
    show.progress(
        f"identifying {int(machine.parameters.free.sum())} parameters from {fitted.n_rows} "
        "equations ..."
    )
    choice = change = None
    if prior is None:
        fit, choice = fitting.fit(machine, fitted)
    else:
        fit, change = recalibrate(
            machine, fitted, load_prior(prior, data), free_limb, fitting.noise
        )
    errors, unjudged = _judged(
        fit, fitted if unseen is None else unseen, limit_position, limit_angle
    )
    validation = None if unseen is None else errors
    origin = collect_provenance(sys.argv, inputs, {"hold_out": seed})
    split = (
        None if unseen is None else {"hold_out": hold_out, "seed": seed, "held_out": unseen.labels}
    )
    findings = {"change": change, "model_choice": choice} | _findings(fit, fitted)
    found = {name: _document(finding) for name, finding in findings.items() if finding is not None}
    reasons = _reasons(fit, validation, unjudged)
    document = (
        {"made_by": origin, "fit": fit, "start": check_start_values(fit), "split": split}
        | {"validation": validation}
        | found
        | {"passed": not reasons, "reasons": reasons}
    )
    save_calibration(output, fit, document, force, fitted)
    show.json_document(document) if as_json else _print(
        fit, errors, unseen is None, findings, output
    )
    return show.gates(reasons)


def _inputs(robot: str, data: Sequence[Path], prior: Path | None) -> dict[str, Path]:
    """Return the files that are read."""
    from loopcal.io.data.measurement_file import list_measurement_files
    from loopcal.io.robot.robot_file import find_robot_file
    from loopcal.io.runs.run_folder import RESULT

    return {
        "robot": find_robot_file(robot),
        **list_measurement_files(data),
        **({} if prior is None else {"prior": prior / RESULT}),
    }


def _held_out(data: Sequence[Path], hold_out: float) -> tuple[str, ...]:
    """Return the poses that the data hold out themselves; refuse to draw others beside them."""
    from loopcal.io.data.pose_use import USE, read_held_out_poses

    planned = read_held_out_poses(data)
    if planned and hold_out:
        raise DataError(
            f"the column {USE!r} of the data says which poses are held out ({len(planned)} of "
            "them); leave out --hold-out, or "
            "the column"
        )
    return planned


def _refuse_contradictions(
    hold_out: bool, gates: bool, prior: Path | None, free_limb: str | None
) -> None:
    """Refuse quality gates without unseen poses, and options that do not go with, or without,
    --prior.
    """
    if gates and not hold_out:
        raise DataError(
            "a quality gate is judged on unseen poses; say which share to keep for it, as "
            "--hold-out 0.25"
        )
    if prior is None and free_limb is not None:
        raise DataError(
            "--free-limb needs the run in which the other limbs were known; name it with --prior "
            "RUN"
        )
    given = click.get_current_context().get_parameter_source
    for option in ("method", "lam", "keep", "loss", "choose_model"):
        if prior is not None and given(option) is click.core.ParameterSource.COMMANDLINE:
            name = option.replace("_", "-")
            raise DataError(
                f"--{name} does not go with --prior, which is fitted by least squares; leave it out"
            )


def _judged(
    fit: Identification,
    data: Measurements,
    limit_position: float | None = None,
    limit_angle: float | None = None,
) -> tuple[Validation | None, str]:
    """Errors on poses, or why there are none: a geometry that went astray may reach no pose."""
    from loopcal.apply import validate

    try:
        return validate(fit, data, limit_position, limit_angle), ""
    except DataError as error:
        return None, str(error)


def _examined(fit: Identification, fitted: Measurements) -> FitExamination | None:
    """Examine a fit that converged."""
    from loopcal.diagnose import examine_fit

    return examine_fit(fit, fitted) if fit.converged else None


def _document(finding: Any) -> Any:
    """A finding, or several, for JSON."""
    return [one.to_dict() for one in finding] if isinstance(finding, tuple) else finding.to_dict()


def _findings(fit: Identification, fitted: Measurements) -> dict[str, Any]:
    """What else is known of a fit; None where there is nothing to say."""
    from loopcal.diagnose import compute_reading_errors, identifiability, suggest_measurements

    open_ = fit.converged and fit.unidentifiable
    return {
        "examination": _examined(fit, fitted),
        "remedies": suggest_measurements(identifiability(fit.robot, fitted)) if open_ else None,
        "reading_errors": compute_reading_errors(fit, fitted),
    }


def _print(
    fit: Identification,
    errors: Validation | None,
    fitted: bool,
    findings: Mapping[str, Any],
    output: Path,
) -> None:
    """Print what was found, and how well it does on unseen poses, or without any on the fitted
    ones.
    """
    from loopcal.diagnose import check_start_values

    found = fit.to_dict()
    show.parameters(f"{fit.robot.name}: {len(fit.names)} parameters", found["parameters"])
    if found["local"]:
        show.say()
        show.parameters(f"Measurements: {len(fit.local)} unknowns", found["local"])
    show.say()
    show.say(
        f"{fit.status.sentence} after {fit.iterations} steps; rank {fit.rank} of {len(fit.names)}"
    )
    degrees = (
        f"{fit.check.degrees:.4g} degree{'' if round(fit.check.degrees) == 1 else 's'} of freedom"
    )
    show.say(f"chi-square {fit.chi_square:.5g} with {degrees}")
    show.say(f"note: {check_start_values(fit).sentence}")
    examined: FitExamination | None = findings["examination"]
    advised = [f"to determine {cure}" for cure in findings["remedies"] or ()]
    for note in (*fit.notes, *advised, *(() if examined is None else examined.sentences)):
        show.say(f"note: {note}")
    if findings["model_choice"] is not None:
        show.say(f"\n{findings['model_choice']}")
    if findings["reading_errors"] is not None:
        show.reading_errors(fit.robot, findings["reading_errors"])
    if errors is not None:
        show.validation(errors, "fitted" if fitted else "unseen")
    if errors is not None and fitted:
        show.say(
            "these rows were fitted, so this proves nothing about other poses; keep some for that "
            "with --hold-out 0.25"
        )
    show.say(f"\nwritten to {output}: result.json, arrays.npz, robot.yaml")


def _reasons(fit: Identification, validation: Validation | None, unjudged: str) -> list[str]:
    """Return a sentence for each thing that is not good enough; `unjudged`: why there are no
    errors.
    """
    reasons = [] if fit.converged else [f"not converged: {fit.status.sentence}"]
    reasons += [fit.check.sentence] if fit.check.failed else []
    reasons += [unjudged] if unjudged else []
    if validation is None:
        return reasons
    for name, smaller in validation.improvements().items():
        if (times := 1.0 / smaller if smaller > 0.0 else float("inf")) > GREW:
            reasons.append(
                f"{name} on unseen poses are {times:.3g} times LARGER after calibration (rms)"
            )
    return [*reasons, *map(str, validation.failures)]
