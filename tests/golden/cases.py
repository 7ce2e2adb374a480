# SPDX-License-Identifier: Apache-2.0
"""Golden cases: small calibrations with fixed seeds, each a function that returns plain results.

Names are paths, `part/what/setting`. Noise is 5 um and 25 urad: far above rounding, so that the
results repeat to less than 1e-9 of their standard deviations. Lengths under the key `kinematic`
are divided by the robot's size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, partial
from importlib import resources
from typing import Any

import numpy as np

import loopcal as lc

Report = dict[str, Any]
UM = 1e-6
SIGMA = {
    lc.Dimension.LENGTH: 5.0 * UM,
    lc.Dimension.ANGLE: 25.0 * UM,
    lc.Dimension.RATIO: 25.0 * UM,
}
"""Noise of simulated measurements, one standard deviation [m], [rad], [1]."""
HEXAPOD, TRIPOD, DELTA, CABLE = "hexapod-42", "3-prs", "linear-delta", "cable-4"
STATED = lc.FitOptions(sigma_uncertainty=0.0)
POINT = np.array([[0.03, -0.02, 0.05]])
THREE = np.array([[0.1, 0.0, 0.02], [-0.06, 0.1, 0.03], [-0.05, -0.1, 0.01]])
STATION = np.eye(4)
STATION[:3, 3] = -1.5, -0.8, 0.1


CASES: dict[str, Callable[[], Report]] = {}


def add(name: str, run: Callable[..., Report], *given: Any, **options: Any) -> None:
    """Register a case."""
    CASES[name] = partial(run, *given, **options)


# Machines, sensors and data


robot = cache(lc.load_robot)


@cache
def truth(name: str) -> np.ndarray:
    """Return true values (p,) of a shipped robot."""
    return lc.sample_truth(robot(name), 1, 3)[0]


def draw(name: str, n: int, seed: int) -> np.ndarray:
    """Draw controlled coordinates (n, c) from the workspace."""
    return lc.sample_workspace(robot(name), n, seed).coordinates


def sense(kind: Any, **seen: Any) -> lc.Sensor:
    """Make a sensor of a kind for `rows`, in `session` and `group`."""
    return lc.Sensor(
        kind, lc.Gaussian(np.array([SIGMA[c.dimension] for c in kind.noise_columns])), **seen
    )


def sense_all(kind: Any, n: int) -> lc.Sensor:
    """Make a sensor of n poses, in pairs or in three groups if the kind needs them."""
    every = np.arange(n)
    rows = every
    if kind.poses_per_row == 2:
        rows = np.concatenate([np.stack([every, np.roll(every, -k)], axis=1) for k in (1, 7, 19)])
    if any(p.scope == "group" for p in kind.nuisance_parameters):
        return sense(kind, rows=rows, group=np.array([f"g{i % 3}" for i in range(len(rows))]))
    return sense(kind, rows=rows)


FULL = sense(lc.KINDS["pose"]())


def measure(name: str, n: int, *sensors: lc.Sensor, seed: int = 1, **options: Any) -> Any:
    """Simulate measurements of a true machine at n poses; full poses unless sensors are given."""
    true = robot(name).with_values(truth(name))
    return lc.simulate(
        true, draw(name, n, seed), lc.Instrument(sensors or (FULL,)), seed, **options
    )


def fit(name: str, data: Any, method: Any = None, **options: Any) -> lc.Identification:
    """Identify the free parameters; the stated sigmas are exact."""
    return lc.identify(robot(name), data, method, options=replace(STATED, **options))


def fit_to_rounding(name: str, data: Any, method: Any = None, **options: Any) -> lc.Identification:
    """Identify, then take three more steps: a descent ends when a step no longer reduces the cost,
    up to 1e-5 standard deviations from the minimum.
    """
    found = fit(name, data, method, **options)
    for _ in range(3):
        again = {"start": found.robot.values, "control": lc.StepControl(relative=1e-4)}
        found = fit(name, data, method, **again, **options)
    return found


@cache
def usual_fit() -> lc.Identification:
    """Return the fit of the hexapod to 24 full poses."""
    return fit(HEXAPOD, measure(HEXAPOD, 24), lc.MAP())


# Reports


def report_fit(found: lc.Identification) -> Report:
    """Report estimates, standard deviations and diagnostics."""
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
        "weight": found.pose_weights,
        **report_unidentifiable(found.names, found.unidentifiable),
    }
    if len(found.nuisance):
        local = found.nuisance
        # one that is determined only together with the machine keeps its start value
        result["local_names"] = list(local.names)
        result["local_open"] = [bool(x) for x in local.is_unobservable]
        result["local"] = {
            "estimate": np.where(np.isinf(local.sd), np.nan, local.estimate),
            "sd": local.sd,
            "scale": np.full(len(local), 1e-3),
        }
    if found.poses is not None:
        at = found.poses
        result["latent"] = {"pose": scale_pose(found.robot, at.poses), "readings": at.readings}
        result["latent"]["open"] = [bool(x) for x in at.is_undetermined]
    return result


def scale_pose(machine: lc.Mechanism, T: np.ndarray) -> np.ndarray:
    """Return the upper three rows of poses, lengths over the robot's size."""
    return T[..., :3, :] / np.array([1.0, 1.0, 1.0, machine.size])


def report_unidentifiable(names: Iterable[str], combinations: Iterable[lc.Combination]) -> Report:
    """Report the null space: its dimension, and the share (0 to 1) of each parameter in it. Its
    basis depends on rounding, but its span does not.
    """
    names, combinations = list(names), list(combinations)
    W = np.zeros((len(combinations), len(names)))
    for row, one in zip(W, combinations, strict=True):
        row[[names.index(name) for name in one.names]] = one.weights
    return {"open": len(W), "unseen": (np.linalg.svd(W, full_matrices=False)[2] ** 2).sum(axis=0)}


def report_identifiability(name: str, data: Any) -> Report:
    """Report what the data determine, and the suggested measurements."""
    outcome = lc.identifiability(robot(name), data)
    suggestions = lc.suggest_measurements(outcome)
    return {
        "rank": outcome.rank,
        "n_equations": outcome.n_equations,
        "condition": outcome.condition,
        "singular_values": outcome.singular_values,
        **report_unidentifiable(outcome.free_parameters.names, outcome.unidentifiable),
        "indices": {one: getattr(outcome.indices, one) for one in ("o1", "o2", "o3", "o4", "o5")},
        "states": [v.state for v in outcome.parameters],
        "left": [v.left for v in outcome.parameters],
        "cures": [[c.words for c in one.measurements] for one in suggestions],
    }


# 1. Every shipped robot


def calibrate(name: str) -> Report:
    """Solve a robot at its true values, and calibrate it from 24 full poses."""
    machine, data = robot(name), measure(name, 24)
    true = machine.with_values(truth(name))
    back = lc.inverse(true, draw(name, 4, 1))
    front = lc.forward(true, lc.inverse(machine, draw(name, 4, 1)).q)
    strokes = [
        machine.size if a.dimension is lc.Dimension.LENGTH else 1.0 for a in machine.actuators
    ]
    found = fit_to_rounding(name, data, lc.MAP(), allow_fewer_equations=True)
    return {
        "measured": data.observations[0].measured,
        "inverse_status": back.status,
        "forward_status": front.status,
        "kinematic": {
            "inverse_readings": back.q / strokes,
            "forward_pose": scale_pose(machine, front.T),
        },
        **report_fit(found),
    }


ROBOTS = sorted(
    path.name.removesuffix(".yaml")
    for path in (resources.files("loopcal") / "robots").iterdir()
    if path.name.endswith(".yaml")
)
for _name in ROBOTS:
    add(f"robots/{_name}", calibrate, _name)


# 2. Kinds of measurement together, methods, losses, trials


KINDS = {
    "pose": lc.Pose(),
    "framed-pose": lc.Pose(unknown=("frame", "tool"), frame="tracker"),
    "targets": lc.Position(
        targets=("a", "b", "c"), places=THREE, unknown=("frame", "targets"), frame="laser"
    ),
    "position": lc.Position(places=POINT, unknown=("frame",), frame="cmm"),
    "inclination": lc.Inclination(unknown=("gravity",), sensor="level"),
    "bearing": lc.Bearing(places=POINT, T_base_frame=STATION, unknown=("frame",), frame="station"),
    "separation": lc.Separation(places=POINT, unknown=("offset",)),
    "plane": lc.Plane(places=POINT, unknown=("surface",), surface="bed"),
    "line": lc.Line(unknown=("surface",), along=np.array([0.6, 0.0, 0.8]), surface="ruler"),
    "sphere": lc.Sphere(unknown=("surface",), through=np.array([1.5, -0.8, 1.1]), surface="ball"),
    "direction": lc.Direction(
        axis=np.array([0.0, 0.6, 0.8]), unknown=("axis", "frame"), frame="gauge", axis_name="face"
    ),
    "mirror": lc.Autocollimation(unknown=("frame", "mirror"), frame="collimator", mirror="mirror"),
    "wire": lc.Distance(anchor=np.array([0.5, -0.4, 0.6]), unknown=("offset",), anchor_name="wire"),
    "tilt": lc.Component(("z", "phi", "theta"), "tilt-torsion"),
}


def calibrate_with_kinds(*names: str, unknowns: Mapping[str, float] | None = None) -> Report:
    """Calibrate a hexapod from several kinds at once, and say what they determine together."""
    sensors = [sense_all(KINDS[name], 24) for name in names]
    data = measure(HEXAPOD, 24, *sensors, seed=2, nuisance_values=unknowns)
    return {
        "map": report_fit(fit(HEXAPOD, data, lc.MAP())),
        "ls": report_fit(fit(HEXAPOD, data, lc.LeastSquares(), allow_fewer_equations=True)),
        "known": report_identifiability(HEXAPOD, data),
    }


COMBINED = {
    ("position", "inclination", "bearing", "separation", "plane"): {"cmm.x": 0.01},
    ("pose", "targets"): {"laser.y": -0.01, "laser.rx": 0.2},
    ("framed-pose", "tilt", "wire"): {"tracker.z": 0.015, "tracker.ry": -0.2},
    ("tilt", "line", "sphere"): {},
    ("targets", "direction", "mirror", "separation"): {"laser.z": 0.01, "gauge.rx": 0.1},
}
for _names, _unknowns in COMBINED.items():
    add(f"combined/{'+'.join(_names)}", calibrate_with_kinds, *_names, unknowns=_unknowns)


def calibrate_by_method(method: Any, *kinds: str, **options: Any) -> Report:
    """Calibrate a hexapod by a method."""
    data = measure(HEXAPOD, 30, *[sense(KINDS[kind]) for kind in kinds])
    return report_fit(fit(HEXAPOD, data, method, allow_fewer_equations=True, **options))


METHODS = {
    "least-squares": lc.LeastSquares(),
    "ridge-0.5": lc.Ridge(0.5),
    "ridge-gcv": lc.Ridge(lc.GCV()),
    "ridge-likelihood": lc.Ridge(lc.MarginalLikelihood()),
    "tsvd-20": lc.TruncatedSVD(20),
    "tsvd-gcv": lc.TruncatedSVD(lc.TruncationGCV()),
    "map": lc.MAP(),
    "map-inflated": lc.MAP(lc.InflatedTolerances()),
}
for _name, _method in METHODS.items():
    add(f"methods/{_name}", calibrate_by_method, _method, "tilt")
add("methods/noise-estimated", calibrate_by_method, lc.LeastSquares(), "pose", noise="estimated")


@cache
def measure_with_outliers() -> Any:
    """Return 30 poses of which three are off by tens of sigma."""
    data = measure(HEXAPOD, 30)
    (seen,) = data.observations
    values, rng = np.array(seen.measured), np.random.default_rng(4)
    for pose in (3, 10, 22):
        step = rng.standard_normal(6)
        values[pose] += 25.0 * step / np.linalg.norm(step) * np.repeat([25.0, 5.0], 3) * UM
    return replace(data, observations=(replace(seen, measured=values),))


def examine_outliers(**options: Any) -> Report:
    """Calibrate from data with blunders, and look for the blunders."""
    data = measure_with_outliers()
    found = fit_to_rounding(HEXAPOD, data, lc.LeastSquares(), **options)
    seen, lack = lc.find_outliers(found, data), lc.examine_fit(found, data).lack_of_fit
    return {
        **report_fit(found),
        "outliers": list(seen.names),
        "distance": [o.distance for o in seen.outliers],
        "leverage": seen.influence.leverage,
        "pure": lack.pure,
        "lack": lack.lack,
    }


add("outliers/least-squares", examine_outliers)
add("losses/huber", examine_outliers, loss=lc.Huber())
add("losses/tukey", examine_outliers, loss=lc.Tukey())


def calibrate_trials(name: str, method: Any, *kinds: str) -> Report:
    """Identify four machines at once."""
    machine, sensors = robot(name), tuple(sense(KINDS[kind]) for kind in kinds)
    true, looking = lc.sample_truth(machine, 4, 3), lc.Instrument(sensors)
    trials = lc.simulate_trials(machine, true, draw(name, 24, 1), looking, 1)
    found = lc.identify_trials(machine, trials, method)
    free = found.free_parameters
    return {
        "status": found.status,
        "fit": {
            "estimate": found.values[:, free.places],
            "sd": found.standard_deviations(),
            "scale": np.broadcast_to(free.tolerance, (len(found.values), len(free))),
        },
        "cost": found.cost,
        "rank": found.decomposition.rank,
    }


add("trials/3-prs/map", calibrate_trials, TRIPOD, lc.MAP(), "pose")
add("trials/hexapod-42/ridge-gcv", calibrate_trials, HEXAPOD, lc.Ridge(lc.GCV()), "pose")
add("trials/hexapod-42/frame", calibrate_trials, HEXAPOD, lc.MAP(), "position", "inclination")


# 3. Uncertain readings, sessions, surfaces, earlier fits


def calibrate_with_uncertain_readings(name: str, sensor: lc.Sensor, sigma: float, n: int) -> Report:
    """Calibrate where readings have noise of their own [m] or [rad]."""
    return report_fit(fit(name, measure(name, n, sensor, reading_sigma=sigma), lc.MAP()))


EIGHT = sense(lc.Position(places=POINT), rows=np.arange(8))
for _name, _seen, _sigma, _n in (
    (HEXAPOD, FULL, 10.0 * UM, 20),
    (TRIPOD, FULL, 10.0 * UM, 20),
    (CABLE, EIGHT, np.deg2rad(1.0), 24),
):
    add(f"readings/{_name}", calibrate_with_uncertain_readings, _name, _seen, _sigma, _n)


def calibrate_in_sessions(method: Any) -> Report:
    """Calibrate with a base that drifts over three sessions."""
    day = np.repeat(["morning", "noon", "evening"], 10)
    drift = {"noon.frame.x": 400 * UM, "evening.frame.x": 900 * UM, "evening.frame.ry": 1e-3}
    seen = sense(lc.Pose(unknown=("frame",)), session=day)
    return report_fit(fit(HEXAPOD, measure(HEXAPOD, 30, seen, nuisance_values=drift), method))


add("sessions/least-squares", calibrate_in_sessions, lc.LeastSquares())
add("sessions/map", calibrate_in_sessions, lc.MAP())


def calibrate_on_surfaces() -> Report:
    """Calibrate with three unknown planes and two lines."""
    plane = lc.Plane(targets=("probe",), unknown=("surface", "targets"), surface="bed")
    groups, lines = (np.array([f"g{i % k}" for i in range(n)]) for n, k in ((42, 3), (20, 2)))
    sensors = sense(plane, group=groups), sense(KINDS["line"], rows=np.arange(20), group=lines)
    return report_fit(fit(HEXAPOD, measure(HEXAPOD, 42, *sensors), lc.MAP()))


add("surfaces/map", calibrate_on_surfaces)


def calibrate_again() -> Report:
    """Calibrate a machine again from few poses, with an earlier fit as prior."""
    data = measure(HEXAPOD, 8, seed=9)
    found, change = lc.recalibrate(robot(HEXAPOD), data, usual_fit().posterior, options=STATED)
    tested = {"change": change.change, "chi_square": change.chi_square, "degrees": change.degrees}
    return report_fit(found) | {"tested": tested}


add("recalibration/unchanged", calibrate_again)


# 4. Plans, papers, and what follows a fit


def plan(name: str, kind: str, n: int, criterion: str) -> Report:
    """Plan poses."""
    options = lc.PlanOptions(seed=1, hold_out=3, n_candidates=60)
    made = lc.plan(robot(name), lc.Instrument((sense(KINDS[kind]),)), n, criterion, options)
    return {
        "held_out": [bool(x) for x in made.poses.held_out],
        "coordinates": made.poses.coordinates,
        "figures": dict(made.quality.figures),
        "expected": [made.errors.after.position, made.errors.after.orientation],
    }


add("plans/hexapod-42/D", plan, HEXAPOD, "pose", 10, "D")
add("plans/3-prs/I", plan, TRIPOD, "pose", 10, "I")


def run_hexapod_42(noise: tuple[float, float] | None) -> Report:
    """Run steps of the study of 42 parameters; noise: limits [mm, rad], None for exact poses."""
    from loopcal.papers.hexapod_42 import results as steps

    setup = steps.make_setup()
    measured = setup.actual if noise is None else steps.draw_measured_poses(setup, noise, 0)
    result = steps.iterate(setup, measured, 3)
    off = setup.truth.values - result.values
    shares = {
        "integrated": result.integrated / result.integrated[0],
        "left": off / np.abs(off[0]).max(),
    }
    return {"actual": measured, "conditions": result.conditions, "kinematic": shares}


add("papers/hexapod-42/exact", run_hexapod_42, None)
add("papers/hexapod-42/noise", run_hexapod_42, (1e-6, 1e-9))


def run_tsvd_2016(name: str, five: bool) -> Report:
    """Run truncated SVD and the library's methods on one machine with the printed noise."""
    from loopcal.papers.tsvd_2016 import steps

    design = steps.load_design(name)
    measured = steps.measure_machines(design, design.draw_true_values(1, 0))
    measured, library = measured.five if five else measured, dict[str, Any]()
    for method, how in steps.LIBRARY.items():
        values = lc.identify_trials(measured.robot, measured.trials, how).values
        errors = measured.compute_output_errors(values)
        library[method] = {"values": values[0], "errors": errors[0, :4]}
    return {"singular_values": steps.linearize(measured).singular_values[0], "library": library}


add("papers/tsvd-2016/RU-PUS-PRS", run_tsvd_2016, "RU-PUS-PRS", five=True)
add("papers/tsvd-2016/3-PRS", run_tsvd_2016, "3-PRS", five=False)


def run_cmm_constraint_2011() -> Report:
    """Plan points, draw machines, and calibrate them from planes and lines in the paper's form."""
    from loopcal.papers.cmm_constraint_2011 import results as steps

    grid = steps.load_grid(steps.CASE, 0, 3)
    (level,) = grid.poses.values()
    study = steps.plan_points(grid, replace(level, count=64, groups=8, sweeps=1))
    errors, noise = ({text: float(text)} for text in steps.find_figure_5())
    (cell,) = steps.calibrate(study, steps.change_sizes(study.grid, errors, noise)).values()
    return {
        "design": study.optimized.design,
        "value": study.optimized.history[-1],
        "converged": cell.converged,
        "errors": cell.errors,
    }


add("papers/cmm-constraint-2011", run_cmm_constraint_2011)


def validate(name: str, *kinds: str) -> Report:
    """Judge a fit on poses held out."""
    data = measure(name, 32, *[sense(KINDS[kind]) for kind in kinds])
    checked = lc.validate(
        fit(name, data.take(np.arange(24)), lc.MAP()), data.take(np.arange(24, 32))
    )
    errors = {
        one.replace(" ", "_"): {"position": e.position, "orientation": e.orientation}
        for one, e in checked.errors().items()
        if one.startswith("predicted")
    }
    kinds_ = {k.kind: [k.before, k.after] for k in checked.kinds}
    return {"errors": errors, "kinds": kinds_, "passed": checked.passed}


add("validation/3-prs", validate, TRIPOD, "pose")
add("validation/hexapod-42/three-kinds", validate, HEXAPOD, "pose", "tilt", "wire")


def map_accuracy() -> Report:
    """Map the accuracy of a fit over the workspace."""
    at = lc.accuracy_map(usual_fit(), measure(HEXAPOD, 24).readings, 20, 2, "base")
    return {
        "sd": at.uncertainty.sd,
        "position": at.uncertainty.position,
        "ratio": at.position_ratio,
    }


add("accuracy/hexapod-42", map_accuracy)


def compensate() -> Report:
    """Compensate the commands of a calibrated machine."""
    done = lc.compensate(usual_fit(), draw(HEXAPOD, 6, 4), "commands", steps=4)
    reached = {
        "readings": done.readings / done.robot.size,
        "reached": scale_pose(done.robot, done.reached),
    }
    assert done.uncertainty is not None
    return {"reach": [r.value for r in done.reach], "kinematic": reached, "sd": done.uncertainty.sd}


add("compensation/hexapod-42", compensate)


def cross_validate() -> Report:
    """Score a method on four folds."""
    data = measure(HEXAPOD, 24)
    found = lc.cross_validate(robot(HEXAPOD), data, lc.MAP(), count=4, seed=1)
    return {"score": found.score, "standard_error": found.standard_error, "fold": found.fold}


add("cross-validation/map", cross_validate)


def identify(name: str, *kinds: str) -> Report:
    """Report what kinds determine."""
    return report_identifiability(name, measure(name, 24, *[sense(KINDS[kind]) for kind in kinds]))


add("identifiability/hexapod-42/tilt", identify, HEXAPOD, "tilt")
add("identifiability/linear-delta/plane", identify, DELTA, "plane")
