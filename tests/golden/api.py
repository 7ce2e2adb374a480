# SPDX-License-Identifier: Apache-2.0
# with them
"""The adapter between the golden cases and loopcal: the only file of the golden results that
imports loopcal.

If names in loopcal move, only this file changes. Functions that report return plain dicts of
arrays, numbers and strings. Lengths under the key `kinematic` are divided by the robot's size.
Other objects that functions exchange (robots, data, fits) are opaque to the cases.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import loopcal as lc
from loopcal import geometry
from loopcal.diagnose.conventions.convention_check import compare_conventions
from loopcal.diagnose.cross_validation import score_leave_one_out
from loopcal.diagnose.identifiable_parameters import suggest_measurements
from loopcal.diagnose.row_errors import PoseErrors
from loopcal.diagnose.start_values import check_start_values
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.nuisance import StatedValue, collect_nuisance_parameters
from loopcal.mechanism.compilation import build
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import ParameterTable
from loopcal.planning.design_space import A, D, PriorInformation
from loopcal.planning.exchange import coordinate_exchange, fedorov_exchange
from loopcal.planning.plane_line_planning import PlaneLineGroups
from loopcal.planning.problem import prepare_problem
from loopcal.units import Dimension

Array = NDArray[np.float64]
Report = dict[str, Any]
Robot = Any
Data = Any
Fit = Any

SIGMA = {Dimension.LENGTH: 5e-6, Dimension.ANGLE: 25e-6, Dimension.RATIO: 25e-6}
"""Noise of all simulated measurements unless a case states another, one standard deviation [m],
[rad], [1].
"""


# --- robots and kinematics
# ---


def robot_names() -> list[str]:
    """Name every robot that comes with loopcal."""
    return sorted(list_shipped_robots())


@cache
def robot(name: str) -> Robot:
    """Load a shipped robot."""
    return load_robot(name)


@cache
def robot_with_leg_joints() -> Robot:
    """Build hexapod-42 with passive joints in its legs, for joint sensors."""
    record = replace(robot("hexapod-42").record.record, legs="ups")
    return build(record.expand(), record=record)


def free_only(machine: Robot, endings: Sequence[str]) -> Robot:
    """Free only the parameters whose names have one of these endings."""
    entries = tuple(
        replace(p, free=p.name.endswith(tuple(endings))) for p in machine.parameters.entries
    )
    return replace(machine, parameters=ParameterTable(entries))


def true_values(machine: Robot, seed: int, trials: int = 1) -> Array:
    """Draw true parameter values (t, p) from the tolerances."""
    return lc.sample_truth(machine, trials, seed)


def with_values(machine: Robot, values: Array) -> Robot:
    """Give a robot other parameter values (p,)."""
    return machine.with_values(values)


def change_value(machine: Robot, values: Array, name: str, change: float) -> Array:
    """Change one of the values (p,) [SI]."""
    moved = values.copy()
    moved[machine.parameters.names.index(name)] += change
    return moved


def replace_by_nominal(machine: Robot, values: Array, endings: Sequence[str]) -> Array:
    """Return `values` (p,) with nominal ones for parameters whose names have these endings."""
    chosen = [name.endswith(tuple(endings)) for name in machine.parameters.names]
    return np.where(chosen, machine.values, values)


def draw_poses(machine: Robot, n: int, seed: int) -> Array:
    """Draw controlled coordinates (n, c) from the workspace."""
    return sample_workspace(machine, n, seed).coordinates


def passive_names(machine: Robot) -> tuple[str, ...]:
    """Name the passive joints."""
    return inverse(machine, machine.home[None]).passive_names


def actuator_names(machine: Robot) -> tuple[str, ...]:
    """Name the actuators."""
    return tuple(a.name for a in machine.actuators)


def transform(point: Sequence[float], turn: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
    """Return a transform (4, 4) of a point [m] and a rotation vector [rad]."""
    return geometry.make_pose(geometry.exp_so3(np.array(turn)), np.array(point))


def report_kinematics(machine: Robot, values: Array, coordinates: Array) -> Report:
    """Solve inverse and forward kinematics and sensitivities of the robot at these values."""
    true = machine.with_values(values)
    back = inverse(true, coordinates)
    front = forward(true, inverse(machine, coordinates).q)
    result = differentiate_pose(true, true.values[None], front.q[None], front.state)
    rows = np.array([1.0] * 3 + [1.0 / machine.size] * 3)[:, None]
    lengths = np.array([_size(machine, d) for d in machine.parameters.dimensions])
    strokes = np.array([_size(machine, a.dimension) for a in machine.actuators])
    return {
        "parameters": list(machine.parameters.names),
        "inverse_status": back.status,
        "forward_status": front.status,
        "passive_names": list(back.passive_names),
        "kinematic": {
            "nominal": np.nan_to_num(machine.values / lengths),
            "inverse_readings": back.q / strokes,
            "inverse_pose": _pose(machine, back.T),
            "inverse_passive": back.passive,
            "forward_pose": _pose(machine, front.T),
            "forward_passive": front.passive,
            "by_parameters": result.parameters[0] * rows * lengths,
            "by_readings": result.readings[0] * rows * strokes,
        },
    }


def _size(machine: Robot, dimension: Dimension) -> float:
    """Return the divisor that removes the unit of a quantity."""
    return machine.size if dimension is Dimension.LENGTH else 1.0


def _pose(machine: Robot, T: Array) -> Array:
    """Return the upper three rows of poses, lengths over the robot's size."""
    return T[..., :3, :] / np.array([1.0, 1.0, 1.0, machine.size])


# --- measurements
# ---


def kind_names() -> list[str]:
    """Name every kind of measurement."""
    return list(KINDS)


def make_kind(name: str, *args: Any, **settings: Any) -> Any:
    """Make a kind of measurement."""
    return KINDS[name](*args, **settings)


def most_unknown_example(name: str) -> Any:
    """Return the last example of a kind, in which most is unknown."""
    return KINDS[name].examples()[-1]


def joint_example(name: str, machine: Robot) -> Any:
    """Return the last example of a joint sensor, on the passive joints or else the driven ones."""
    passive = passive_names(machine)
    return replace(
        most_unknown_example(name), joints=passive or actuator_names(machine), measures="angle"
    )


def make_sensor(made: Any, sigma: ArrayLike | None = None, **seen: Any) -> Any:
    """Make a sensor of a kind with this noise for `rows`, in `session` and `group`."""
    default = [SIGMA[c.dimension] for c in made.noise_columns]
    noise = (
        np.array(default)
        if sigma is None
        else np.broadcast_to(np.asarray(sigma, dtype=float), len(default)).copy()
    )
    return Sensor(made, Gaussian(noise), **seen)


def make_sensor_of_all_poses(
    made: Any, n: int, steps: Sequence[int] = (1, 7, 19), groups: int = 3
) -> Any:
    """Make a sensor of n poses, in pairs or groups if the kind needs them."""
    every = np.arange(n)
    rows = (
        np.concatenate([np.stack([every, np.roll(every, -k)], axis=1) for k in steps])
        if made.poses_per_row == 2
        else every
    )
    grouped = any(p.scope == "group" for p in made.nuisance_parameters)
    group = np.array([f"g{i % groups}" for i in range(len(rows))]) if grouped else np.array("")
    return make_sensor(made, rows=rows, group=group)


def simulate_data(
    machine: Robot,
    values: Array,
    coordinates: Array,
    sensors: Iterable[Any],
    seed: int,
    unknowns: Mapping[str, float] | None = None,
    reading_sigma: ArrayLike | None = None,
) -> Data:
    """Simulate measurements of a machine with these true values."""
    looking = Instrument(tuple(sensors))
    true = machine.with_values(values)
    return lc.simulate(
        true, coordinates, looking, seed, nuisance_values=unknowns, reading_sigma=reading_sigma
    )


def simulate_trials(
    machine: Robot, values: Array, coordinates: Array, sensors: Iterable[Any], seed: int
) -> Data:
    """Simulate stacked measurements of machines with true values (t, p)."""
    return lc.simulate_trials(machine, values, coordinates, Instrument(tuple(sensors)), seed)


def select_trial(trials: Data, i: int) -> Data:
    """Return the measurements of one trial."""
    return trials.trial(i)


def draw_setup_values(
    machine: Robot, sensors: Iterable[Any], n: int, seed: int
) -> dict[str, float]:
    """Draw true setup values within 20 mm and 0.3 rad of the stated ones."""
    reach = {Dimension.LENGTH: 0.02, Dimension.ANGLE: 0.3}
    seeing = [s.assign_rows(n) for s in Instrument(tuple(sensors)).with_tool(machine).sensors]
    table = collect_nuisance_parameters(seeing, tuple(map(str, range(n)))).table
    span = np.array([reach[p.dimension] for p in table.entries])
    drawn = np.random.default_rng(seed).uniform(-span, span)
    drawn = np.where([name.endswith("offset") for name in table.names], np.abs(drawn), drawn)
    return dict(zip(table.names, (table.nominal + drawn).tolist(), strict=True))


def take_poses(data: Data, rows: ArrayLike) -> Data:
    """Take some poses of the data."""
    return data.take(np.asarray(rows))


def replace_measured(data: Data, measured: Array, place: int = 0) -> Data:
    """Put other measured values in the place of those of one kind."""
    seen = list(data.observations)
    seen[place] = replace(seen[place], measured=measured)
    return replace(data, observations=tuple(seen))


def copy_measured(data: Data, place: int = 0) -> Array:
    """Return a copy of the measured values (r, c) of one kind."""
    return np.array(data.observations[place].measured)


def copy_readings(data: Data) -> tuple[Array, Array | None]:
    """Return copies of readings (n, a) and of their sigma."""
    sigma = data.reading_sigma
    return np.array(data.readings), None if sigma is None else np.array(sigma)


def replace_readings(data: Data, readings: Array, sigma: Array | None) -> Data:
    """Put other readings and sigmas into the data."""
    return replace(data, readings=readings, reading_sigma=sigma)


def state_values(data: Data, known: Mapping[str, tuple[float, float | None]]) -> Data:
    """State priors of unknowns: name -> (standard deviation, value); a deviation of 0 fixes it."""
    return replace(
        data,
        stated_values=tuple(StatedValue(name, sd, value) for name, (sd, value) in known.items()),
    )


def report_data(data: Data) -> Report:
    """Return what was measured."""
    seen = {f"{i}_{o.kind.name}": o.measured for i, o in enumerate(data.observations)}
    return {"measured": seen, "readings": data.readings, "labels": list(data.labels)}


# --- fits
# ---


def make_method(name: str, value: Any = None) -> Any:
    """Make a method by its name: ls, map, map-widened, ridge, ridge-gcv, ridge-likelihood, tsvd,
    tsvd-gcv.
    """
    from loopcal.estimate.tolerance_components import InflatedTolerances

    makers = {
        "ls": lc.LeastSquares,
        "map": lambda: lc.MAP() if value is None else lc.MAP(value),
        "map-widened": lambda: lc.MAP(InflatedTolerances()),
        "ridge": lambda: lc.Ridge(value),
        "ridge-gcv": lambda: lc.Ridge(lc.GCV()),
        "ridge-likelihood": lambda: lc.Ridge(lc.MarginalLikelihood()),
        "tsvd": lambda: lc.TruncatedSVD(value),
        "tsvd-gcv": lambda: lc.TruncatedSVD(lc.TruncationGCV()),
    }
    return makers[name]()


def make_loss(name: str, constant: float | None = None) -> Any:
    """Make a loss by its name: huber, tukey."""
    made = {"huber": lc.Huber, "tukey": lc.Tukey}[name]
    return made() if constant is None else made(constant)


def fit(machine: Robot, data: Data, how: Any = None, **options: Any) -> Fit:
    """Identify the free parameters; the stated sigmas are exact, unless the options differ."""
    names = {"drop": "excluded_poses", "local": "nuisance"}
    given = {names.get(name, name): value for name, value in options.items()}
    given = {"sigma_uncertainty": 0.0, **given}
    return lc.identify(machine, data, how, options=lc.FitOptions(**given))


def fit_to_rounding(machine: Robot, data: Data, how: Any = None, **options: Any) -> Fit:
    """Identify, then take three more steps, so that the estimate is exact to rounding.

    The descent ends when a step no longer reduces the cost, up to 1e-5 standard deviations from
    the minimum.
    """
    result = fit(machine, data, how, **options)
    one_step = lc.StepControl(relative=1e-4)
    for _ in range(3):
        result = fit(machine, data, how, start=result.robot.values, control=one_step, **options)
    return result


def report_fit(found: Fit, parts: bool = True) -> Report:
    """Report estimates, standard deviations and diagnostics; with `parts` also setup parameters,
    poses and combinations.
    """
    check = found.residual_test
    result: Report = {
        "names": list(found.names),
        "status": found.status.name,
        "rank": found.rank,
        "fit": {
            "estimate": found.estimate,
            "sd": found.standard_deviations,
            "scale": found.tolerance,
        },
        "condition": found.spectrum.condition,
        "singular_values": found.spectrum.singular_values,
        "cost": found.history.cost[-1],
        "chi_square": check.chi_square,
        "degrees": check.degrees,
        "dof": check.dof,
        "p_value": check.p_value,
        "sigma_scale": check.sigma_scale,
        "intervals": check.intervals,
        **_report_unidentifiable(found.names, found.unidentifiable),
    }
    if not parts:
        return result
    finite = np.isfinite(found.standard_deviations)
    result["half_widths"] = found.interval()[finite][:1]
    result["weight"] = (
        found.pose_weights if (found.pose_weights != 1.0).any() else "all poses count in full"
    )
    result["squares"] = {
        f"{i}_{r.kind}": (r.whitened**2).sum(axis=0) for i, r in enumerate(found.residuals)
    }
    if len(found.nuisance):
        local = found.nuisance
        # a setup parameter that is determined only together with the machine keeps its start
        # value
        known, scale = (
            np.where(np.isinf(local.sd), np.nan, local.estimate),
            np.full(len(local), 1e-3),
        )
        result["local_names"] = list(local.names)
        result["local_open"] = [bool(x) for x in local.is_unobservable]
        result["local"] = {"estimate": known, "sd": local.sd, "scale": scale}
    if found.prior_conflict is not None:
        one = found.prior_conflict
        result["conflict"] = {
            "found": one.conflict,
            "statistic": one.statistic,
            "spread": one.inflation,
            "p_value": one.p_value,
        }
    if found.poses is not None:
        at = found.poses
        result["latent"] = {
            "pose": _pose(found.robot, at.poses),
            "readings": at.readings,
            "calm": bool(at.is_converged),
        }
        result["latent"]["open"] = [bool(x) for x in at.is_undetermined]
    return result


def _report_unidentifiable(names: Sequence[str], combinations: Sequence[Any]) -> Report:
    """Report the null space: its dimension, its parameters, and the share (0 to 1) of each in it.

    The basis of several directions depends on rounding, but their span does not. A single
    direction is reported in full, in the order of the parameters, its first component that is
    not small positive.
    """
    W = np.zeros((len(combinations), len(names)))
    for row, one in zip(W, combinations, strict=True):
        row[[names.index(name) for name in one.names]] = one.weights
    basis = np.linalg.svd(W, full_matrices=False)[2]
    unseen = (basis**2).sum(axis=0)
    result: Report = {
        "open": len(W),
        "unseen": unseen,
        "touched": [n for n, u in zip(names, unseen, strict=True) if u > 1e-12],
    }
    if len(W) == 1:
        first = np.flatnonzero(np.abs(W[0]) > 0.1 * np.abs(W[0]).max())[0]
        result["combination"] = W[0] * np.sign(W[0, first])
    return result


def report_trials(machine: Robot, trials: Data, how: Any) -> Report:
    """Identify stacked trials at once."""
    result = lc.identify_trials(machine, trials, how)
    free = result.free_parameters
    return {
        "status": result.status,
        "fit": {
            "estimate": result.values[:, free.places],
            "sd": result.standard_deviations(),
            "scale": np.broadcast_to(free.tolerance, (len(result.values), len(free))),
        },
        "cost": result.cost,
        "rank": result.decomposition.rank,
        "singular_values": result.decomposition.singular_values,
    }


def report_leave_one_out(machine: Robot, data: Data, methods: Sequence[Any]) -> Report:
    """Score methods by leave-one-out from one linearization."""
    result = score_leave_one_out(machine, data, tuple(methods))
    return {"score": result.score, "dof": result.dof, "best": list(methods).index(result.best)}


def report_per_leg(machine: Robot, data: Data, steps: int) -> Report:
    """Identify leg by leg."""
    from loopcal.estimate.published_steps import identify_per_leg

    result = identify_per_leg(machine, data, steps)
    return {"values": result.robot.values, "conditions": result.conditions}


def fix_setup(data: Data, pattern: str, values: Mapping[str, float] | None = None) -> Any:
    """Return the setup parameters of the data, some of them fixed."""
    local = collect_nuisance_parameters(data.observations, data.labels)
    return local.with_nominal(local.values(values)).with_fixed(pattern)


def set_setup_prior(data: Data, pattern: str, sd: float) -> Any:
    """Return the setup parameters of the data, some with a prior of this standard deviation."""
    return collect_nuisance_parameters(data.observations, data.labels).with_prior(pattern, sd)


def make_prior(earlier: Fit) -> Any:
    """Make a prior of an earlier fit."""
    return lc.prior_from(earlier.posterior)


def report_recalibration(
    machine: Robot, data: Data, earlier: Fit, limb: str | None = None
) -> Report:
    """Calibrate again with an earlier fit as prior, and test for a change."""
    exact = lc.FitOptions(sigma_uncertainty=0.0)
    result, change = lc.recalibrate(machine, data, earlier.posterior, limb, options=exact)
    tested = {
        "what": change.subject,
        "names": list(change.names),
        "moved": change.moved,
        "change": change.change,
        "chi_square": change.chi_square,
        "degrees": change.degrees,
        "p_value": change.p_value,
    }
    return {"again": report_fit(result, parts=False), "change": tested}


# --- identifiability, validation and diagnosis
# ---


def report_identifiability(machine: Robot, data: Data, cures: bool = False) -> Report:
    """Report what the data determine, and with `cures` the suggested measurements."""
    outcome = lc.identifiability(machine, data)
    result: Report = {
        "rank": outcome.rank,
        "n_parameters": outcome.n_parameters,
        "n_equations": outcome.n_equations,
        "improved": outcome.improved,
        "condition": outcome.condition,
        "singular_values": outcome.singular_values,
        **_report_unidentifiable(outcome.free_parameters.names, outcome.unidentifiable),
        "weak_values": [c.singular_value for c in outcome.weak],
        "indices": {
            name: getattr(outcome.indices, name) for name in ("o1", "o2", "o3", "o4", "o5")
        },
        "states": [v.state for v in outcome.parameters],
        "partners": [list(v.partners) for v in outcome.parameters],
        "left": [v.left for v in outcome.parameters],
    }
    if cures:
        suggestions = suggest_measurements(outcome)
        result["cures"] = [[c.words for c in r.measurements] for r in suggestions]
        result["cures_left"] = {
            str(i): [c.left for c in r.measurements] for i, r in enumerate(suggestions)
        }
    return result


def add_millimeters_and_radians(errors: PoseErrors) -> Array:
    """Return position [mm] plus orientation error [rad], which core has no more, of the rows that
    measure both.
    """
    position, orientation = errors["position"], errors["orientation"]
    single = np.array([not target for target in position.targets], dtype=bool)
    rows = position.rows[single]
    both = np.isin(orientation.rows, rows)
    millimeters = position.size[single][np.isin(rows, orientation.rows)] / 1e-3
    return millimeters + orientation.size[both]


def report_validation(found: Fit, data: Data) -> Report:
    """Report held-out errors."""
    checked = lc.validate(found, data)
    errors = {
        name.replace(" ", "_"): {
            "position": e.position,
            "orientation": e.orientation,
            "integrated": add_millimeters_and_radians(e),
        }
        for name, e in checked.errors().items()
        if name.startswith("predicted")
    }
    # what is left of a commanded pose may be rounding alone: as a share of the robot's size
    size = found.robot.size
    commanded = {
        name.replace(" ", "_"): {"position": e.position / size, "orientation": e.orientation}
        for name, e in checked.errors().items()
        if not name.startswith("predicted")
    }
    kinds = {k.kind: [k.before, k.after] for k in checked.kinds}
    return {
        "poses": list(checked.poses),
        "errors": errors,
        "kinematic": commanded,
        "kinds": kinds,
        "passed": checked.passed,
    }


def report_cross_validation(machine: Robot, data: Data, how: Any, count: int, seed: int) -> Report:
    """Score a method on folds."""
    result = lc.cross_validate(machine, data, how, count=count, seed=seed)
    return {
        "poses": list(result.poses),
        "score": result.score,
        "standard_error": result.standard_error,
        "fold": result.fold,
        "before_fold": result.before_fold,
        "after_position": result.after.position,
        "converged": bool(result.converged),
    }


def report_model_choice(machine: Robot, data: Data, how: Any, count: int) -> Report:
    """Choose a set of parameters by cross-validation."""
    result = lc.choose_model(machine, data, None, how, count=count)
    return {
        "names": [c.name for c in result.candidates],
        "parameters": [list(c.parameters) for c in result.candidates],
        "scores": [c.score for c in result.candidates],
        "chosen": result.chosen.name,
        "best": result.best.name,
    }


def report_accuracy(found: Fit, data: Data, n: int, seed: int, frame: Any = "base") -> Report:
    """Report uncertainties over the workspace."""
    at = lc.accuracy_map(found, data.readings, n, seed, frame)
    return {
        "names": list(at.names),
        "coordinates": at.coordinates,
        "sd": at.uncertainty.sd,
        "position": at.uncertainty.position,
        "orientation": at.uncertainty.orientation,
        "position_ratio": at.position_ratio,
        "orientation_ratio": at.orientation_ratio,
        "extrapolated": [bool(x) for x in at.extrapolated],
    }


def report_monte_carlo(
    machine: Robot, coordinates: Array, sensors: Iterable[Any], where: Array, trials: int
) -> Report:
    """Compare predicted with observed uncertainties over a few drawn machines."""
    result = lc.simulate_accuracy(
        machine, coordinates, Instrument(tuple(sensors)), where, trials=trials
    )
    return {
        "predicted_sd": result.predicted.sd,
        "observed": result.observed,
        "trials": result.trials,
        "failed": result.failed,
    }


def report_compensation(found: Any, targets: Array, mode: Any, **options: Any) -> Report:
    """Report compensated commands."""
    done = lc.compensate(found, targets, mode, **options)
    robot_ = done.robot
    strokes = np.array([_size(robot_, a.dimension) for a in robot_.actuators])
    rows = np.array([1.0] * 3 + [1.0 / robot_.size] * 3)
    result: Report = {
        "reach": [r.value for r in done.reach],
        "kinematic": {
            "readings": done.readings / strokes,
            "reached": _pose(robot_, done.reached),
            "before": done.before * rows,
            "remaining": done.remaining * rows,
            "not_compensable": done.not_compensable * rows,
        },
    }
    if done.commands is not None:
        result["kinematic"]["commands"] = done.commands
    if done.uncertainty is not None:
        result["sd"] = done.uncertainty.sd
    return result


def report_outliers(found: Fit, data: Data) -> Report:
    """Report outliers."""
    seen = lc.find_outliers(found, data)
    return {
        "names": list(seen.names),
        "undecided": [[list(block) for block in one.poses] for one in seen.ambiguous],
        "distance": [o.distance for o in seen.outliers],
        "degrees": [o.degrees for o in seen.outliers],
        "p_value": [o.p_value for o in seen.outliers],
        "settled": bool(seen.is_converged),
        "blocks": seen.blocks,
        "scale": seen.scale,
        "leverage": seen.influence.leverage,
    }


def report_examination(found: Fit, data: Data) -> Report:
    """Report lack of fit, correlated parameters, the expected gain, and the check of the start."""
    seen = lc.examine_fit(found, data)
    lack, worth, start = seen.lack_of_fit, seen.gain, check_start_values(found)
    return {
        "groups": lack.groups,
        "pure": lack.pure,
        "pure_degrees": lack.pure_degrees,
        "lack": lack.lack,
        "lack_degrees": lack.lack_degrees,
        "p_value": lack.p_value,
        "explained": lack.is_explained,
        "worth": [
            worth.position_before,
            worth.position_after,
            worth.angle_before,
            worth.angle_after,
        ],
        "calibrate": worth.is_worthwhile,
        "correlated": [list(group.names) for group in seen.correlated],
        "start": start.verdict.name,
        "start_before": start.before,
        "start_after": start.after,
    }


def report_conventions(machine: Robot, data: Data) -> Report:
    """Report the convention check."""
    result = compare_conventions(machine, data)
    return {
        "misfit": result.misfit,
        "doubtful": bool(result.is_doubtful),
        "refused": bool(result.is_refused),
        "other_misfit": result.other_misfit,
        "alike": len(result.alternatives),
    }


def report_parameter_error(found: Fit, truth: Array) -> Report:
    """Report errors of parameters with and without the unidentifiable combinations."""
    off = lc.compare_with_truth(found, truth)
    return {
        "names": list(off.names),
        "raw": off.raw,
        "error": off.error,
        "dropped": len(off.dropped),
    }


# --- plans
# ---


def report_plan(
    machine: Robot, sensors: Iterable[Any], n: int, criterion: str, **options: Any
) -> Report:
    """Plan poses; `station` and `facing` ask for a line of sight, `tilt` [rad] and `margin` for the
    others.
    """
    if "candidates" in options:
        options["n_candidates"] = options.pop("candidates")
    plan = lc.plan(machine, Instrument(tuple(sensors)), n, criterion, lc.PlanOptions(**options))
    poses, errors = plan.poses, plan.errors
    result: Report = {
        "labels": list(poses.labels),
        "held_out": [bool(x) for x in poses.held_out],
        "via_home": [bool(x) for x in poses.via_home],
        "units": poses.groups,
        "coordinates": poses.coordinates,
        "readings": poses.readings,
        "figures": dict(plan.quality.figures),
        "efficiency": plan.quality.efficiency,
        "expected": [errors.after.position, errors.after.orientation],
        "length": poses.path_length,
        "considered": plan.quality.n_candidates,
    }
    if errors.random is not None:
        result["even"] = [errors.random.position, errors.random.orientation]
    return result


def report_fedorov(
    machine: Robot, sensors: Iterable[Any], n: int, criterion: str, candidates: int, starts: int
) -> Report:
    """Choose n units from candidates by exchange: their numbers and the criterion."""
    settings = lc.PlanOptions(n_candidates=candidates)
    problem = prepare_problem(machine, Instrument(tuple(sensors)), settings)
    design = problem.pose_design(name=criterion)
    result = fedorov_exchange(design, n, seed=1, starts=starts)
    return {"chosen": result.chosen, "value": result.value, "candidates": len(design.rows)}


def report_coordinate_exchange(
    machine: Robot,
    groups: int,
    points: int,
    criterion: str,
    sweeps: int,
    axes: tuple[str, ...] = ("x", "y", "z"),
) -> Report:
    """Improve groups of points on planes and lines by coordinate exchange."""
    planned = PlaneLineGroups(machine, points, 1e-3, axes)
    first = planned.draw(groups, 1)
    wanted = {"D": D(), "A": A()}[criterion]
    start = PriorInformation.none(len(planned.free))
    result = coordinate_exchange(
        lambda _, design: planned.linearize(design),
        first,
        planned.list_levels(),
        wanted,
        start,
        sweeps=sweeps,
    )
    return {
        "first": first,
        "design": result.design,
        "value": result.value,
        "evaluated": result.evaluated,
    }


def report_surface_plan(machine: Robot, groups: int, points: int) -> Report:
    """Plan points on planes and perpendicular lines."""
    plan = lc.plan_surfaces(machine, lc.SurfaceOptions(groups, points))
    u, k = plan.poses.groups.shape
    return {
        "labels": list(plan.poses.labels),
        "axis": plan.axis,
        "coordinates": plan.poses.coordinates.reshape(u, k, -1),
        "via_home": plan.poses.via_home.reshape(u, k),
        "rank": plan.rank,
        "first": plan.sd_first,
        "last": plan.sd_last,
    }


# --- papers
# ---


def report_hexapod_42(noise: tuple[float, float] | None, iterations: int) -> Report:
    """Run the ten steps of the study of 42 parameters; noise: limits [mm, rad], None for exact
    poses.
    """
    from loopcal.papers.hexapod_42 import steps

    setup = steps.make_setup()
    measured = steps.draw_measured_poses(setup, None if noise is None else steps.to_si(noise), 0)
    result = steps.iterate(setup, measured, iterations)
    off = result.compute_parameter_errors(setup.truth)
    return {
        "commanded": setup.commanded.q,
        "actual": measured,
        "conditions": result.conditions,
        # what exact poses leave in the end is rounding: errors as shares of the first
        "kinematic": {
            "integrated": result.integrated / result.integrated[0],
            "left": off / np.abs(off[0]).max(),
        },
    }


def report_hexapod_42_table_4() -> Report:
    """Ask which Euler order and which odd row explain the printed poses."""
    from loopcal.papers.hexapod_42 import steps

    setup, printed = steps.make_setup(), steps.PRINTED.table("table_4", "PP")
    measured = printed.values / np.array([1e3] * 3 + [1.0] * 3)
    orders = steps.rank_euler_orders(setup, setup.poses[2:], measured[2:])
    odd = steps.search_outliers(setup, printed)
    return {
        "order": orders[0].formula,
        "position": [o.position for o in orders[:6]],
        "named": list(odd.labels),
        "first": [o.chi_square for o in odd.first],
        "last": [o.chi_square for o in odd.last],
    }


def report_hexapod_42_methods(trials: int) -> Report:
    """Compare methods on the stated noise, but least squares over all legs: ten narrow poses hardly
    determine it.
    """
    from loopcal.papers.hexapod_42 import steps

    methods = steps.compare_methods(steps.make_setup(), 0, trials)
    result = {name: m for name, m in methods.items() if not name.startswith("all legs")}
    return {
        "names": list(result),
        "errors": [[m.parameters, m.narrow, m.wide] for m in result.values()],
    }


def report_tsvd_2016(name: str, five: bool) -> Report:
    """Run raw ridge estimation and truncated SVD, and the library's methods, on one machine with
    the printed noise.
    """
    from loopcal.estimate.published_steps import penalize_ridge, penalize_truncated
    from loopcal.papers.tsvd_2016 import steps

    measured = steps.measure_case(name, 0)
    measured = measured.five if five else measured
    p = len(measured.robot.parameters)
    s = steps.linearize(measured).singular_values[0]
    rank = int((s > 1e-11 * s[0]).sum())
    ks = np.array([rank, rank - 2, rank - 5])
    run = steps.iterate(
        measured,
        np.concatenate([penalize_truncated(ks, p), penalize_ridge(np.array([1e-3, 1e-1]), p)]),
        limit=20,  # the first version ended ridge there; it now runs until its steps are small
        ahead=0.0,
    )
    library = steps.run_library(measured)
    errors = measured.compute_output_errors(run.values, run.machine)
    return {
        "rank": rank,
        "singular_values": s,
        "converged": run.is_converged,
        "diverged": run.is_diverged,
        "values": run.values,
        "errors": errors[:, :4],
        "library": {
            name: {"values": a.values, "errors": a.errors[:4]} for name, a in library.items()
        },
    }


def report_cmm_constraint_2011(groups: int, points: int, sweeps: int, trials: int) -> Report:
    """Plan points, draw machines, and calibrate them from planes and lines in the paper's form."""
    from loopcal.papers.cmm_constraint_2011 import steps

    study = steps.plan_points(groups, points, seed=0, sweeps=sweeps)
    made = {
        weights: steps.calibrate_cell(study, 1e-3, 1e-5, 0, trials, weights=weights)
        for weights in ("printed", "full")
    }
    return {
        "design": study.optimized.design,
        "value": study.optimized.value,
        "spread": list(study.spreads),
        "failed": [one.failed for one in made.values()],
        "errors": {weights: dict(one.errors) for weights, one in made.items()},
    }


def report_cmm_constraint_2011_surfaces(groups: int, points: int, noise: float) -> Report:
    """Calibrate one machine from planes and lines with the surfaces as unknowns."""
    from loopcal.papers.cmm_constraint_2011 import steps

    study = steps.plan_points(groups, points, seed=0, sweeps=0)
    q = study.layout.solve_readings(steps.draw_true_machines(study.robot, 1e-3, 1, 0), noise, 0)
    data = steps.build_measurements(study.layout, q[0], noise)
    options = lc.FitOptions(rank_tolerance=1e-5, sigma_uncertainty=0.0)
    result = lc.identify(study.robot, data, lc.MAP(), options=options)
    return report_fit(result, parts=False)
