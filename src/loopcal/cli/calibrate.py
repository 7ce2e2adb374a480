# SPDX-License-Identifier: Apache-2.0
"""`loopcal calibrate`: identify a robot from measurements, prove it on held-out poses, keep it in a run folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, data_argument, data_options, gate_options, json_option, robot_argument
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.calibrate import Identification, Validation
    from loopcal.calibrate.filters import Method
    from loopcal.measure import Measurements

METHODS = ("least-squares", "map", "ridge", "truncated-svd")


@click.command(short_help="Identify a robot's parameters from measurements.")
@robot_argument
@data_argument
@click.option("-o", "--output", required=True, type=FILE, help="The run folder to make.")
@click.option("--hold-out", type=click.FloatRange(0, 1, max_open=True), default=0.0, metavar="SHARE",
              help="Share of the poses to keep from the fit and to judge it by, such as 0.25.")  # fmt: skip
@click.option("--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True, help="How to estimate.")
@click.option("--lam", type=click.FloatRange(min=0), help="For ridge; chosen by cross-validation where not given.")
@click.option("--keep", type=click.IntRange(min=0), metavar="K",
              help="For truncated-svd: how many directions; chosen by cross-validation where not given.")  # fmt: skip
@click.option("--noise", type=click.Choice(("given", "estimated")), default="given", show_default=True,
              help="Whether the stated noise is true, or only up to one common factor.")  # fmt: skip
@click.option("--prior", type=FILE, metavar="RUN", help="An earlier run on this machine; what it knew is kept.")
@click.option("--free-limb", metavar="LIMB", help="With --prior: a limb that was repaired, such as leg3, starts anew.")
@gate_options
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the held-out choice.")
@data_options
@click.option("--force", is_flag=True, help="Replace a run that is there.")
@json_option
def calibrate(
    robot: str,
    data: Path,
    output: Path,
    hold_out: float,
    method: str,
    lam: float | None,
    keep: int | None,
    noise: Literal["given", "estimated"],
    prior: Path | None,
    free_limb: str | None,
    limit_position: float | None,
    limit_angle: float | None,
    seed: int,
    allow_outside_stroke: bool,
    allow_duplicates: bool,
    force: bool,
    as_json: bool,
) -> int:
    """Identify the free parameters of ROBOT from DATA and write a run folder with the corrected robot file.

    The exit code is 2 where a quality gate is not met, or the iteration did not converge.

    \b
    Examples:
      loopcal calibrate hexapod-42 measurements.csv -o run --hold-out 0.25
      loopcal calibrate robot.yaml data.csv -o run --hold-out 0.25 --limit-position 0.02mm --limit-angle 0.01deg
      loopcal calibrate printer.yaml heights.csv -o run --noise estimated
      loopcal calibrate hexapod-42 after-repair.csv -o run2 --prior run --free-limb leg3
    """  # noqa: D301
    from loopcal.calibrate import identify, validate
    from loopcal.calibrate.recalibrate import recalibrate
    from loopcal.io import load_measurements, load_robot
    from loopcal.io.calibration_run import run_document, save_run
    from loopcal.io.compensation_file import load_prior
    from loopcal.io.robot_file import robot_path
    from loopcal.io.run_folder import RESULT, made_by, refuse_used_folder

    _refuse_contradictions(hold_out, limit_position is not None or limit_angle is not None, prior, free_limb)
    refuse_used_folder(output, force)
    machine = load_robot(robot)
    measured = load_measurements(data, machine, allow_outside_stroke=allow_outside_stroke, allow_duplicates=allow_duplicates)
    fitted, unseen = measured.split(1 - hold_out, seed) if hold_out else (measured, None)
    show.progress(f"identifying {int(machine.parameters.free.sum())} parameters from {fitted.n_rows} equations ...")
    if prior is None:
        fit, change = identify(machine, fitted, _method(method, lam, keep), noise=noise), None
    else:
        fit, change = recalibrate(machine, fitted, load_prior(prior, data), free_limb, noise)
    validation = None if unseen is None else validate(fit, unseen, limit_position, limit_angle)
    inputs = {"robot": robot_path(robot), "data": data, **({} if prior is None else {"prior": prior / RESULT})}
    origin = made_by(sys.argv, inputs, {"hold_out": seed})
    split = None if unseen is None else {"hold_out": hold_out, "seed": seed, "held_out": unseen.labels}
    document = run_document(fit, validation, origin, split) | ({} if change is None else {"change": change.to_dict()})
    save_run(output, fit, document, force)
    if as_json:
        show.json_document(document)
    else:
        _print(fit, validation, fitted, output)
    return _exit_code(fit, validation)


def _refuse_contradictions(hold_out: float, gates: bool, prior: Path | None, free_limb: str | None) -> None:
    """Refuse quality gates without unseen poses, and options that do not go with, or without, --prior."""
    if gates and not hold_out:
        raise DataError("a quality gate is judged on unseen poses; say which share to keep for it, as --hold-out 0.25")
    if prior is None and free_limb is not None:
        raise DataError("--free-limb needs the run in which the other limbs were known; name it with --prior RUN")
    given = click.get_current_context().get_parameter_source
    for option in ("method", "lam", "keep"):
        if prior is not None and given(option) is click.core.ParameterSource.COMMANDLINE:
            raise DataError(f"--{option} does not go with --prior, which stands in the place of the tolerances; leave it out")


def _method(name: str, lam: float | None, keep: int | None) -> Method:
    """Return the method that the options describe."""
    from loopcal.calibrate import GCV, MAP, LeastSquares, Ridge, TruncatedSVD, TruncationGCV

    for option, value, needs in (("--lam", lam, "ridge"), ("--keep", keep, "truncated-svd")):
        if value is not None and name != needs:
            raise DataError(f"{option} belongs to --method {needs}, not to {name}; leave it out, or change the method")
    if name == "ridge":
        return Ridge(GCV() if lam is None else lam)
    if name == "truncated-svd":
        return TruncatedSVD(TruncationGCV() if keep is None else keep)
    return MAP() if name == "map" else LeastSquares()


def _print(fit: Identification, validation: Validation | None, fitted: Measurements, output: Path) -> None:
    """Print what was found, and how well it does on unseen poses, or without any on the fitted ones."""
    from loopcal.calibrate import start_check, validate

    show.parameters(f"{fit.robot.name}: {len(fit.names)} parameters", fit.to_dict()["parameters"])
    show.say()
    show.say(f"{fit.status.sentence} after {fit.iterations} steps; rank {fit.rank} of {len(fit.names)}")
    degrees = f"{fit.check.degrees:.4g} degree{'' if round(fit.check.degrees) == 1 else 's'} of freedom"
    show.say(f"chi-square {fit.chi_square:.5g} with {degrees}")
    show.say(f"note: {start_check(fit).sentence}")
    for note in fit.notes:
        show.say(f"note: {note}")
    if validation is not None:
        show.validation(validation, "unseen")
    elif not any(observations.kind.unknowns for observations in fitted.observations):
        show.validation(validate(fit, fitted), "fitted")
        show.say("these rows were fitted, so this proves nothing about other poses; keep some for that with --hold-out 0.25")
    show.say(f"\nwritten to {output}: result.json, arrays.npz, robot.yaml")


def _exit_code(fit: Identification, validation: Validation | None) -> int:
    """Return 0, or 2 with a sentence for each thing that is not good enough."""
    reasons: list[Any] = [] if fit.converged else [f"not converged: {fit.status.sentence}"]
    reasons += [] if validation is None else validation.reasons
    return show.gates(reasons)
