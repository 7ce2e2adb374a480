# SPDX-License-Identifier: Apache-2.0
"""The registry of golden cases: small calibrations with fixed seeds, each a function that returns
plain results.

Names are paths, `part/what/setting`. Noise is 5 um and 25 urad by default: far above rounding, so
that the results repeat to less than 1e-9 of their standard deviations. Fits with losses, of chains
and of other robots are followed to rounding, because a descent ends before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from tests.golden import api

UM = 1e-6
POINT = np.array([[0.03, -0.02, 0.05]])
PAIR = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])
THREE = np.array([[0.1, 0.0, 0.02], [-0.06, 0.1, 0.03], [-0.05, -0.1, 0.01]])
STATION = api.transform((-1.5, -0.8, 0.1))
HEXAPOD, TRIPOD, DELTA, CABLE = "hexapod-42", "3-prs", "linear-delta", "cable-4"


@dataclass(frozen=True)
class Case:
    """A named computation."""

    run: Callable[[], dict[str, Any]]
    slow: bool


CASES: dict[str, Case] = {}
SLOW = (
    "kinds/",
    "combined/",
    "recalibration/",
    "plans/",
    "papers/tsvd-2016/",
    "papers/cmm-constraint-2011/",
    "outliers/",
    "cross-validation/",
    "identifiability/",
)
"""Beginnings of the names of cases that take longest; continuous integration repeats the others
with several kernels of linear algebra.
"""


def add(name: str, run: Callable[..., dict[str, Any]], *given: Any, **options: Any) -> None:
    """Register a case."""
    assert name not in CASES, name
    CASES[name] = Case(partial(run, *given, **options), name.startswith(SLOW))


# --- shared set-ups


@cache
def truth(name: str, seed: int = 3) -> np.ndarray:
    """Return true values (p,) of a shipped robot."""
    return api.true_values(api.robot(name), seed)[0]


def simulate_measurements(name: str, n: int, *sensors: Any, seed: int = 1, **options: Any) -> Any:
    """Return measurements of a true machine at n poses; full poses unless sensors are given."""
    robot = api.robot(name)
    seen = sensors or (api.make_sensor(api.make_kind("pose")),)
    return api.simulate_data(
        robot, truth(name), api.draw_poses(robot, n, seed), seen, seed, **options
    )


def report_fit_of(name: str, data: Any, how: Any = None, **options: Any) -> dict[str, Any]:
    """Identify a shipped robot and report."""
    return api.report_fit(api.fit(api.robot(name), data, how, **options))


@cache
def usual_fit(how: str = "map", name: str = HEXAPOD) -> Any:
    """Return the fit of a robot to 24 full poses."""
    return api.fit(api.robot(name), simulate_measurements(name, 24), api.make_method(how))


# --- 1. every shipped robot


SECOND_ORDER = ("linear-delta-6", "ls")
"""Some directions have second-order effects only; least squares does not converge in them, so they
are cut.
"""


def kinematics(name: str) -> dict[str, Any]:
    """Solve a robot at four poses, at nominal and at true values."""
    robot = api.robot(name)
    at = api.draw_poses(robot, 4, 1)
    return {
        "poses": {"kinematic": at},
        "nominal": api.report_kinematics(robot, robot.values, at[:2]),
        "true": api.report_kinematics(robot, truth(name), at),
    }


def calibration(name: str, how: str) -> dict[str, Any]:
    """Calibrate a robot from 24 full poses."""
    data = simulate_measurements(name, 24)
    options = {"rank_tolerance": 3e-4} if (name, how) == SECOND_ORDER else {}
    result = api.report_fit(
        api.fit_to_rounding(
            api.robot(name), data, api.make_method(how), allow_fewer_equations=True, **options
        )
    )
    return {"data": api.report_data(data) if how == "map" else {}, **result}


for _name in api.robot_names():
    add(f"robots/{_name}/kinematics", kinematics, _name)
    add(f"robots/{_name}/map", calibration, _name, "map")
    add(f"robots/{_name}/least-squares", calibration, _name, "ls")


# --- 2. every kind of measurement


SMALL_SET = ("length",)
"""Endings of the parameters that least squares estimates with weak kinds; all 42 would be
ill-conditioned.
"""


def calibrate_with_kind(
    kind: Any, n: int = 30, machine: Any = None, lean: bool = False
) -> dict[str, Any]:
    """Calibrate a hexapod with one kind, whose setup parameters are off, by LS and MAP."""
    robot = machine or api.robot(HEXAPOD)
    values = api.true_values(robot, 3)[0]
    sensors = (api.make_sensor_of_all_poses(kind, n),)
    own = api.draw_setup_values(robot, sensors, n, 5)
    data = api.simulate_data(robot, values, api.draw_poses(robot, n, 1), sensors, 1, unknowns=own)
    less = (
        api.with_values(
            api.free_only(robot, SMALL_SET), api.replace_by_nominal(robot, values, SMALL_SET)
        )
        if lean
        else robot
    )
    return {
        "data": api.report_data(data)["measured"],
        "ls": api.report_fit(
            api.fit_to_rounding(less, data, api.make_method("ls"), allow_fewer_equations=True)
        ),
        "map": api.report_fit(api.fit_to_rounding(robot, data, api.make_method("map"))),
    }


JOINTS = ("joint", "locked")
MORE_ROWS = {
    "direction": 40,
    "inclination": 40,
    "autocollimation": 40,
    "plane": 60,
    "distance": 60,
    "sphere": 60,
    "component": 60,
}
"""Numbers of poses for kinds with few values in a row."""


def calibrate_with_joint_sensors(name: str) -> dict[str, Any]:
    """Calibrate a hexapod with joints in its legs from sensors on these."""
    robot = api.robot_with_leg_joints()
    return calibrate_with_kind(api.joint_example(name, robot), 10, robot)


SUBSTITUTES = {
    "component": api.make_kind(
        "component", ("x", "y", "z", "phi", "theta"), "tilt-torsion", unknown=("frame",)
    ),
    "distance": api.make_kind(
        "distance", anchor=np.array([0.5, -0.4, 0.6]), unknown=("anchor",), anchor_name="wire1"
    ),
    "sphere": api.make_kind(
        "sphere", unknown=("surface",), through=np.array([0.1, -0.08, 0.3]), surface="ball"
    ),
    "inclination": api.make_kind("inclination", unknown=("gravity",), sensor="level"),
}
"""Replacements of examples in which the start of the setup parameters depends on rounding."""

WEAK_KINDS = (
    "line",
    "plane",
    "bearing",
    "direction",
    "autocollimation",
    "bearing/theodolite",
    "bearing/camera",
    "distance",
    "distance/known",
    "sphere",
    "sphere/known",
)

FORMS = {
    "pose/quaternion": api.make_kind("pose", "quaternion"),
    "pose/tilt-torsion": api.make_kind("pose", "tilt-torsion"),
    "pose/euler-ZYX": api.make_kind("pose", "euler-ZYX"),
    "component/z": api.make_kind("component", ("z",)),
    "component/x,y,z,phi,theta": api.make_kind(
        "component", ("x", "y", "z", "phi", "theta"), "tilt-torsion"
    ),
    "position/known": api.make_kind("position", targets=("a", "b", "c"), places=THREE),
    "bearing/theodolite": api.make_kind("bearing", places=POINT, T_base_frame=STATION),
    "bearing/camera": api.make_kind(
        "bearing",
        T_base_frame=api.transform((0.1, -0.1, -0.8)),
        form="camera",
        unknown=("frame",),
        frame="camera",
    ),
    "distance/known": api.make_kind("distance", anchor=np.array([1.5, -0.8, 1.1])),
    "sphere/known": api.make_kind("sphere", through=np.array([1.5, -0.8, 1.1])),
}

for _name in api.kind_names():
    if _name == "closure":  # of machines with redundant actuators only
        continue
    if _name in JOINTS:
        add(f"kinds/{_name}", calibrate_with_joint_sensors, _name)
    else:
        _kind = SUBSTITUTES.get(_name) or api.most_unknown_example(_name)
        add(
            f"kinds/{_name}",
            calibrate_with_kind,
            _kind,
            MORE_ROWS.get(_name, 30),
            lean=_name in WEAK_KINDS,
        )
for _name, _kind in FORMS.items():
    _poses = 48 if _name.split("/")[0] in ("component", "distance", "sphere") else 20
    add(f"kinds/{_name}", calibrate_with_kind, _kind, _poses, lean=_name in WEAK_KINDS)


def calibrate_with_kinds(kinds: dict[str, Any], n: int = 24) -> dict[str, Any]:
    """Calibrate a hexapod from several kinds at once, and say what they determine together."""
    robot = api.robot(HEXAPOD)
    sensors = tuple(api.make_sensor_of_all_poses(kind, n) for kind in kinds.values())
    own = api.draw_setup_values(robot, sensors, n, 6)
    data = api.simulate_data(
        robot, truth(HEXAPOD), api.draw_poses(robot, n, 2), sensors, 2, unknowns=own
    )
    return {
        "map": report_fit_of(HEXAPOD, data, api.make_method("map")),
        "ls": report_fit_of(HEXAPOD, data, api.make_method("ls"), allow_fewer_equations=True),
        "known": api.report_identifiability(robot, data),
    }


PARTS = {
    "pose": api.make_kind("pose"),
    "framed-pose": api.make_kind("pose", unknown=("frame", "tool"), frame="tracker"),
    "targets": api.make_kind(
        "position",
        targets=("a", "b", "c"),
        places=THREE,
        unknown=("frame", "targets"),
        frame="laser",
    ),
    "position": api.make_kind("position", places=POINT, unknown=("frame",), frame="cmm"),
    "inclination": api.make_kind("inclination", unknown=("gravity",), sensor="level"),
    "bearing": api.make_kind(
        "bearing", places=POINT, T_base_frame=STATION, unknown=("frame",), frame="station"
    ),
    "separation": api.make_kind("separation", places=POINT, unknown=("offset",)),
    "plane": api.make_kind("plane", places=POINT, unknown=("surface",), surface="bed"),
    "line": api.make_kind(
        "line", unknown=("surface",), along=np.array([0.6, 0.0, 0.8]), surface="ruler"
    ),
    "sphere": api.make_kind(
        "sphere", unknown=("surface",), through=np.array([1.5, -0.8, 1.1]), surface="ball"
    ),
    "direction": api.make_kind(
        "direction",
        axis=np.array([0.0, 0.6, 0.8]),
        unknown=("axis", "frame"),
        frame="gauge",
        axis_name="face",
    ),
    "mirror": api.make_kind(
        "autocollimation", unknown=("frame", "mirror"), frame="collimator", mirror="mirror"
    ),
    "wire": api.make_kind(
        "distance", anchor=np.array([0.5, -0.4, 0.6]), unknown=("offset",), anchor_name="wire"
    ),
    "tilt": api.make_kind("component", ("z", "phi", "theta"), "tilt-torsion"),
}
COMBINED = (
    ("position", "inclination", "bearing", "separation", "plane"),
    ("pose", "targets"),
    ("framed-pose", "tilt", "wire"),
    ("tilt", "line", "sphere"),
    ("targets", "direction", "mirror", "separation"),
)
for _names in COMBINED:
    add(
        f"combined/{'+'.join(_names)}", calibrate_with_kinds, {name: PARTS[name] for name in _names}
    )


# --- 3. every method and loss, stacked trials


def calibrate_by_method(how: str, value: Any, weak: bool, **options: Any) -> dict[str, Any]:
    """Calibrate a hexapod by a method: full poses, or (weak) heights and tilts that leave
    directions open.
    """
    sensors = (api.make_sensor(PARTS["tilt"]),) if weak else ()
    return report_fit_of(
        HEXAPOD,
        simulate_measurements(HEXAPOD, 30, *sensors),
        api.make_method(how, value),
        **options,
    )


LAMBDAS = tuple(np.linspace(0.0, 4.0, 42).tolist())
METHODS: dict[str, tuple[str, Any]] = {
    "least-squares": ("ls", None),
    "ridge-0.5": ("ridge", 0.5),
    "ridge-each": ("ridge", LAMBDAS),
    "ridge-gcv": ("ridge-gcv", None),
    "ridge-likelihood": ("ridge-likelihood", None),
    "tsvd-20": ("tsvd", 20),
    "tsvd-gcv": ("tsvd-gcv", None),
    "map": ("map", None),
    "map-spread-3": ("map", 3.0),
    "map-widened": ("map-widened", None),
}
for _name, (_how, _value) in METHODS.items():
    add(f"methods/{_name}/poses", calibrate_by_method, _how, _value, weak=False)
    add(
        f"methods/{_name}/heights-and-tilts",
        calibrate_by_method,
        _how,
        _value,
        weak=True,
        allow_fewer_equations=True,
    )
for _how in ("ls", "map", "map-widened"):
    add(
        f"methods/noise-estimated/{_how}",
        calibrate_by_method,
        _how,
        None,
        weak=False,
        noise="estimated",
    )
add("methods/begin-closure", calibrate_by_method, "ls", None, weak=False, begin="closure")
add("methods/rank-tolerance", calibrate_by_method, "ls", None, weak=False, rank_tolerance=2e-2)
add("methods/drop", calibrate_by_method, "map", None, weak=False, drop=("2", "17"))


def calibrate_from_start() -> dict[str, Any]:
    """Start from values with twice the true errors."""
    robot = api.robot(HEXAPOD)
    far = api.true_values(robot, 77)[0]
    return report_fit_of(
        HEXAPOD, simulate_measurements(HEXAPOD, 24), api.make_method("ls"), start=far
    )


add("methods/start", calibrate_from_start)


def calibrate_without_tolerances() -> dict[str, Any]:
    """Calibrate some parameters without tolerances."""
    robot = api.free_only(api.robot(HEXAPOD), ("length", "base.z"))
    data = api.simulate_data(
        robot,
        api.true_values(robot, 3)[0],
        api.draw_poses(robot, 20, 1),
        [api.make_sensor(api.make_kind("pose"))],
        1,
    )
    return api.report_fit(api.fit(robot, data))


add("methods/some-parameters-free", calibrate_without_tolerances)


@cache
def make_data_with_outliers(name: str = HEXAPOD) -> Any:
    """Return 30 poses of which three are off by tens of sigma."""
    data = simulate_measurements(name, 30)
    values = api.copy_measured(data)
    rng = np.random.default_rng(4)
    for pose in (3, 10, 22):
        step = rng.standard_normal(6)
        values[pose] += 25.0 * step / np.linalg.norm(step) * np.array([25 * UM] * 3 + [5 * UM] * 3)
    return api.replace_measured(data, values)


def calibrate_by_loss(
    loss: str, how: str, constant: float | None = None, **options: Any
) -> dict[str, Any]:
    """Calibrate from data with blunders, with a loss; and look for the blunders."""
    data = make_data_with_outliers()
    result = api.fit_to_rounding(
        api.robot(HEXAPOD),
        data,
        api.make_method(how),
        loss=api.make_loss(loss, constant),
        **options,
    )
    return api.report_fit(result) | {"outliers": api.report_outliers(result, data)}


for _loss in ("huber", "tukey"):
    for _how in ("ls", "map", "map-widened"):
        add(f"losses/{_loss}/{_how}", calibrate_by_loss, _loss, _how)
add("losses/huber/constant", calibrate_by_loss, "huber", "ls", 2.0)
add("losses/tukey/noise-estimated", calibrate_by_loss, "tukey", "ls", noise="estimated")


def trials(name: str, how: str, value: Any, kinds: tuple[str, ...]) -> dict[str, Any]:
    """Identify four machines at once."""
    robot = api.robot(name)
    sensors = [api.make_sensor(PARTS[kind]) for kind in kinds]
    made = api.simulate_trials(
        robot, api.true_values(robot, 3, 4), api.draw_poses(robot, 24, 1), sensors, 1
    )
    one = api.report_fit(
        api.fit(robot, api.select_trial(made, 2), api.make_method(how, value)), parts=False
    )
    return api.report_trials(robot, made, api.make_method(how, value)) | {"third": one}


for _name in (HEXAPOD, TRIPOD, DELTA):
    add(f"trials/{_name}/map", trials, _name, "map", None, ("pose",))
add("trials/hexapod-42/least-squares", trials, HEXAPOD, "ls", None, ("pose",))
add("trials/hexapod-42/ridge-gcv", trials, HEXAPOD, "ridge-gcv", None, ("pose",))
add("trials/hexapod-42/tsvd-gcv", trials, HEXAPOD, "tsvd-gcv", None, ("pose",))
add("trials/hexapod-42/unknown-frame", trials, HEXAPOD, "map", None, ("position", "inclination"))


def score_leave_one_out() -> dict[str, Any]:
    """Score methods by leave-one-out."""
    wanted = (
        ("ls", None),
        ("map", None),
        ("ridge", 1e-2),
        ("ridge", 10.0),
        ("tsvd", 10),
        ("tsvd", 30),
    )
    methods = [api.make_method(name, value) for name, value in wanted]
    return api.report_leave_one_out(api.robot(HEXAPOD), simulate_measurements(HEXAPOD, 24), methods)


add("methods/leave-one-out", score_leave_one_out)
add(
    "methods/per-leg",
    lambda: api.report_per_leg(api.robot(HEXAPOD), simulate_measurements(HEXAPOD, 12), 3),
)


# --- 4. uncertain readings, sessions, priors


def calibrate_with_uncertain_readings(
    name: str, sigma: float, how: str, *sensors: Any, n: int = 20
) -> dict[str, Any]:
    """Calibrate where readings have noise of their own."""
    return report_fit_of(
        name, simulate_measurements(name, n, *sensors, reading_sigma=sigma), api.make_method(how)
    )


add("latent/hexapod-42/poses", calibrate_with_uncertain_readings, HEXAPOD, 10 * UM, "ls")
add("latent/hexapod-42/map", calibrate_with_uncertain_readings, HEXAPOD, 10 * UM, "map")
add("latent/3-prs/poses", calibrate_with_uncertain_readings, TRIPOD, 10 * UM, "map")
add(
    "latent/hexapod-42/unknown-frame",
    calibrate_with_uncertain_readings,
    HEXAPOD,
    10 * UM,
    "map",
    api.make_sensor(PARTS["position"]),
    n=24,
)
add(
    "latent/hexapod-42/heights",
    calibrate_with_uncertain_readings,
    HEXAPOD,
    10 * UM,
    "map",
    api.make_sensor(PARTS["tilt"]),
    n=30,
)


def calibrate_with_mixed_readings(loss: str | None = None) -> dict[str, Any]:
    """Calibrate with a missing and an exact reading, incomplete and linked poses."""
    robot = api.free_only(
        api.robot(HEXAPOD), ("base.x", "leg2.base.z", "leg3.platform.y", "leg4.length")
    )
    full = api.make_sensor(api.make_kind("pose"), rows=np.arange(10))
    ball = api.make_sensor(api.make_kind("separation"), rows=np.array([[1, 10], [10, 11], [0, 12]]))
    point = api.make_sensor(api.make_kind("position"), rows=np.array([10, 11, 12, 13]))
    coordinates = api.draw_poses(robot, 14, 1)
    data = api.simulate_data(
        robot,
        api.true_values(robot, 3)[0],
        coordinates,
        [full, ball, point],
        1,
        reading_sigma=15 * UM,
    )
    readings, sigma = api.copy_readings(data)
    assert sigma is not None
    readings[2, 4], sigma[2, 4] = np.nan, np.inf
    sigma[5, 0] = 0.0
    data = api.replace_readings(data, readings, sigma)
    return api.report_fit(
        api.fit(
            robot, data, api.make_method("ls"), loss=None if loss is None else api.make_loss(loss)
        )
    )


add("latent/missing-reading-and-linked-poses", calibrate_with_mixed_readings)
add("latent/missing-reading-and-linked-poses/huber", calibrate_with_mixed_readings, "huber")


def calibrate_cable_robot(how: str) -> dict[str, Any]:
    """Calibrate a cable robot from its own redundant readings, a few positions measured."""
    robot = api.robot(CABLE)
    seen = api.make_sensor(api.make_kind("position"), 1e-3, rows=np.arange(8))
    data = api.simulate_data(
        robot, truth(CABLE), api.draw_poses(robot, 24, 5), [seen], 1, reading_sigma=np.deg2rad(1.0)
    )
    result = api.fit(robot, data, api.make_method(how))
    return api.report_fit(result) | {"known": api.report_identifiability(robot, data)}


add("latent/cable-4/map", calibrate_cable_robot, "map")
add("latent/cable-4/least-squares", calibrate_cable_robot, "ls")


def missing_columns() -> dict[str, Any]:
    """Calibrate with missing components of some rows."""
    data = simulate_measurements(HEXAPOD, 24)
    values = api.copy_measured(data)
    values[::3, 3] = np.nan
    values[1::4, :3] = np.nan
    values[5] = np.nan
    return report_fit_of(HEXAPOD, api.replace_measured(data, values), api.make_method("map"))


add("unknowns/missing-components", missing_columns)

DRIFT = {"noon.frame.x": 400 * UM, "evening.frame.x": 900 * UM, "evening.frame.ry": 1e-3}


def sessions(how: str, keep: bool) -> dict[str, Any]:
    """Calibrate with a base that drifts over three sessions; the first frame is known, or none."""
    day = np.repeat(["morning", "noon", "evening"], 10)
    data = simulate_measurements(
        HEXAPOD,
        30,
        api.make_sensor(api.make_kind("pose", unknown=("frame",)), session=day),
        unknowns=DRIFT,
    )
    local = api.fix_setup(data, "morning.*", {"morning.frame.x": 0.0}) if keep else None
    return report_fit_of(HEXAPOD, data, api.make_method(how), local=local)


add("unknowns/sessions/first-kept/least-squares", sessions, "ls", keep=True)
add("unknowns/sessions/all-free/least-squares", sessions, "ls", keep=False)
add("unknowns/sessions/all-free/map", sessions, "map", keep=False)


def stations() -> dict[str, Any]:
    """Calibrate with two stations, one of which was moved."""
    day = np.repeat(["left", "right"], 20)
    seen = api.make_kind(
        "bearing",
        targets=("a", "b"),
        places=PAIR,
        T_base_frame=STATION,
        unknown=("frame", "targets"),
    )
    moved = {"right.frame.x": 1.4, "right.frame.y": -1.1, "right.frame.rz": 2.0}
    data = simulate_measurements(HEXAPOD, 40, api.make_sensor(seen, session=day), unknowns=moved)
    return report_fit_of(HEXAPOD, data, api.make_method("map"))


add("unknowns/stations", stations)


def prior_of_unknowns(stated: bool) -> dict[str, Any]:
    """Calibrate with a prior of a frame, from the data or the fit, and one fixed coordinate."""
    seen = api.make_kind("pose", unknown=("frame",), frame="tracker")
    true = {"tracker.x": 300 * UM, "tracker.ry": 5e-4}
    data = simulate_measurements(HEXAPOD, 24, api.make_sensor(seen), unknowns=true)
    if stated:
        known = {"tracker.x": (1e-3, None), "tracker.y": (1e-4, 2e-5), "tracker.z": (0.0, 0.0)}
        return report_fit_of(
            HEXAPOD,
            api.state_values(data, known),
            api.make_method("ls"),
            allow_fewer_equations=True,
        )
    return report_fit_of(
        HEXAPOD, data, api.make_method("map"), local=api.set_setup_prior(data, "tracker.*", 1e-3)
    )


add("unknowns/prior/stated-in-the-data", prior_of_unknowns, stated=True)
add("unknowns/prior/given-to-the-fit", prior_of_unknowns, stated=False)


def surfaces_in_groups() -> dict[str, Any]:
    """Calibrate with three unknown planes, two lines and a ball of unknown position."""
    plane = api.make_kind(
        "plane", targets=("probe",), unknown=("surface", "targets"), surface="bed"
    )
    line = api.make_kind(
        "line", unknown=("surface",), along=np.array([0.6, 0.0, 0.8]), surface="ruler"
    )
    groups = np.array([f"g{i % 3}" for i in range(42)])
    two = np.array([f"h{i % 2}" for i in range(20)])
    sensors = (
        api.make_sensor(plane, group=groups),
        api.make_sensor(line, rows=np.arange(20), group=two),
    )
    own = api.draw_setup_values(api.robot(HEXAPOD), sensors, 42, 8)
    return report_fit_of(
        HEXAPOD, simulate_measurements(HEXAPOD, 42, *sensors, unknowns=own), api.make_method("map")
    )


add("unknowns/surfaces-in-groups", surfaces_in_groups)


def recalibrate_after_change(change: float, limb: str | None) -> dict[str, Any]:
    """Calibrate again after a leg became longer, an earlier fit as the prior."""
    robot = api.robot(HEXAPOD)
    values = api.change_value(robot, truth(HEXAPOD), "leg3.length", change)
    data = api.simulate_data(
        robot, values, api.draw_poses(robot, 8, 9), [api.make_sensor(api.make_kind("pose"))], 9
    )
    return api.report_recalibration(robot, data, usual_fit(), limb)


add("recalibration/unchanged", recalibrate_after_change, 0.0, None)
add("recalibration/longer-leg", recalibrate_after_change, 300 * UM, None)
add("recalibration/freed-limb", recalibrate_after_change, 300 * UM, "leg3")


def calibrate_with_earlier_fit(how: str) -> dict[str, Any]:
    """Use an earlier fit as prior knowledge of one with too few equations."""
    few = simulate_measurements(HEXAPOD, 4, seed=6)
    result = api.fit_to_rounding(
        api.robot(HEXAPOD), few, api.make_method(how), prior=api.make_prior(usual_fit("ls"))
    )
    return api.report_fit(result)


add("recalibration/prior-from-earlier", calibrate_with_earlier_fit, "ls")


# --- 5. plans


def plan(name: str, kind: str, n: int, criterion: str, **options: Any) -> dict[str, Any]:
    """Plan poses."""
    return api.report_plan(
        api.robot(name), [api.make_sensor(PARTS[kind])], n, criterion, seed=1, **options
    )


for _criterion in ("D", "I"):
    add(
        f"plans/hexapod-42/pose/{_criterion}",
        plan,
        HEXAPOD,
        "pose",
        10,
        _criterion,
        hold_out=3,
        candidates=60,
    )
    add(
        f"plans/3-prs/pose/{_criterion}",
        plan,
        TRIPOD,
        "pose",
        10,
        _criterion,
        hold_out=3,
        candidates=60,
    )
add("plans/linear-delta/position/I", plan, DELTA, "position", 12, "I", hold_out=3, candidates=60)
add(
    "plans/hexapod-42/pose/position",
    plan,
    HEXAPOD,
    "pose",
    8,
    "I",
    target="position",
    hold_out=2,
    candidates=50,
)


def plan_further() -> dict[str, Any]:
    """Plan poses beyond those measured already."""
    before = simulate_measurements(HEXAPOD, 6)
    return plan(HEXAPOD, "pose", 6, "I", candidates=50, hold_out=0, measured=before)


add("plans/hexapod-42/beyond-measured", plan_further)


def fedorov(name: str, kind: str, n: int, criterion: str) -> dict[str, Any]:
    """Choose candidates by exchange."""
    return api.report_fedorov(api.robot(name), [api.make_sensor(PARTS[kind])], n, criterion, 60, 3)


for _criterion in ("D", "I"):
    add(f"plans/fedorov/hexapod-42/{_criterion}", fedorov, HEXAPOD, "pose", 10, _criterion)
    add(f"plans/fedorov/3-prs/{_criterion}", fedorov, TRIPOD, "pose", 10, _criterion)


def exchange(criterion: str, axes: tuple[str, ...]) -> dict[str, Any]:
    """Move groups of points on a plane and a line by coordinate exchange."""
    return api.report_coordinate_exchange(
        api.robot("hexapod-nategh-agheli"), 8, 8, criterion, 1, axes
    )


add("plans/coordinate-exchange/D", exchange, "D", ("x", "y", "z"))
add("plans/coordinate-exchange/A", exchange, "A", ("z",))


add(
    "plans/surfaces/hexapod-nategh-agheli",
    lambda: api.report_surface_plan(api.robot("hexapod-nategh-agheli"), 6, 8),
)


# --- 6. papers

add("papers/hexapod-42/exact", api.report_hexapod_42, None, 3)
add("papers/hexapod-42/presumed-noise", api.report_hexapod_42, (1e-6, 1e-9), 3)
add("papers/hexapod-42/stated-noise", api.report_hexapod_42, (1e-3, 1e-6), 2)
add("papers/hexapod-42/table-4", api.report_hexapod_42_table_4)
add("papers/hexapod-42/methods", api.report_hexapod_42_methods, 3)
for _name in ("RU-PUS-PRS", "3-PRS"):
    for _five in (False, True):
        add(f"papers/tsvd-2016/{_name}/{5 if _five else 6}-dof", api.report_tsvd_2016, _name, _five)
add("papers/cmm-constraint-2011/cell", api.report_cmm_constraint_2011, 8, 8, 1, 3)
add("papers/cmm-constraint-2011/surfaces", api.report_cmm_constraint_2011_surfaces, 8, 8, 1e-5)


# --- 7. validation, accuracy, what is wrong


def validation(name: str, how: str, *kinds: str) -> dict[str, Any]:
    """Judge a fit on poses held out."""
    sensors = [api.make_sensor(PARTS[kind]) for kind in kinds]
    data = simulate_measurements(name, 32, *sensors)
    result = api.fit(api.robot(name), api.take_poses(data, np.arange(24)), api.make_method(how))
    return api.report_validation(result, api.take_poses(data, np.arange(24, 32)))


for _name in (HEXAPOD, TRIPOD, DELTA, "ru-pus-prs", "five-bar"):
    add(f"validation/{_name}", validation, _name, "map", "pose")
add("validation/hexapod-42/targets", validation, HEXAPOD, "map", "pose", "targets")
add("validation/hexapod-42/three-kinds", validation, HEXAPOD, "map", "pose", "tilt", "wire")


def accuracy(name: str, how: str, frame: str) -> dict[str, Any]:
    """Map the accuracy of a fit."""
    return api.report_accuracy(usual_fit(how, name), simulate_measurements(name, 24), 20, 2, frame)


add("accuracy/hexapod-42/base", accuracy, HEXAPOD, "map", "base")
add("accuracy/hexapod-42/platform", accuracy, HEXAPOD, "ls", "platform")
add("accuracy/3-prs/base", accuracy, TRIPOD, "map", "base")


def map_accuracy_with_unknown_frame() -> dict[str, Any]:
    """Map the accuracy of a fit with unobservable frames."""
    data = simulate_measurements(HEXAPOD, 30, api.make_sensor(PARTS["targets"]))
    return api.report_accuracy(
        api.fit(api.robot(HEXAPOD), data, api.make_method("ls")), data, 10, 2
    )


add("accuracy/hexapod-42/open-frame", map_accuracy_with_unknown_frame)


def monte_carlo() -> dict[str, Any]:
    """Compare with a few drawn machines."""
    robot = api.robot(HEXAPOD)
    where = api.draw_poses(robot, 4, 3)
    return api.report_monte_carlo(
        robot, api.draw_poses(robot, 20, 1), [api.make_sensor(PARTS["pose"])], where, 10
    )


add("accuracy/hexapod-42/monte-carlo", monte_carlo)


def compensation(name: str, mode: str, **options: Any) -> dict[str, Any]:
    """Compensate the commands of a calibrated machine."""
    return api.report_compensation(
        usual_fit("map", name), api.draw_poses(api.robot(name), 6, 4), mode, **options
    )


for _name in (HEXAPOD, TRIPOD, DELTA):
    add(f"compensation/{_name}/readings", compensation, _name, "readings")
    add(f"compensation/{_name}/commands", compensation, _name, "commands", steps=4)


def outliers(how: str) -> dict[str, Any]:
    """Detect outliers and examine the fit."""
    data = make_data_with_outliers()
    result = api.fit(api.robot(HEXAPOD), data, api.make_method(how))
    clean = usual_fit("ls")
    return {
        "blunders": api.report_outliers(result, data),
        "clean": api.report_outliers(clean, simulate_measurements(HEXAPOD, 24)),
        "examined": api.report_examination(result, data),
    }


add("outliers/least-squares", outliers, "ls")
add("outliers/map", outliers, "map")


def repeats() -> dict[str, Any]:
    """Measure every pose twice."""
    robot = api.robot(HEXAPOD)
    at = np.repeat(api.draw_poses(robot, 15, 1), 2, axis=0)
    data = api.simulate_data(robot, truth(HEXAPOD), at, [api.make_sensor(PARTS["pose"])], 1)
    result = api.fit(robot, data, api.make_method("map"))
    return api.report_examination(result, data) | {
        "error": api.report_parameter_error(result, truth(HEXAPOD))
    }


add("validation/repeats", repeats)


def cross_validation(how: str, value: Any = None) -> dict[str, Any]:
    """Score a method on four folds."""
    return api.report_cross_validation(
        api.robot(HEXAPOD), simulate_measurements(HEXAPOD, 24), api.make_method(how, value), 4, 1
    )


add("cross-validation/map", cross_validation, "map")
add("cross-validation/tsvd-20", cross_validation, "tsvd", 20)
add(
    "cross-validation/choose-model",
    lambda: api.report_model_choice(
        api.robot(DELTA),
        simulate_measurements(DELTA, 20, api.make_sensor(PARTS["position"])),
        api.make_method("map"),
        3,
    ),
)


def identifiability(name: str, *kinds: str, cures: bool = True) -> dict[str, Any]:
    """Report what kinds determine, and the suggested measurements."""
    robot = api.robot(name)
    data = simulate_measurements(name, 24, *[api.make_sensor(PARTS[kind]) for kind in kinds])
    return api.report_identifiability(robot, data, cures)


for _name in api.robot_names():
    add(f"identifiability/{_name}/pose", identifiability, _name, "pose", cures=False)
add("identifiability/hexapod-42/tilt", identifiability, HEXAPOD, "tilt")
add("identifiability/3-prs/tilt", identifiability, TRIPOD, "tilt")
add("identifiability/linear-delta/heights", identifiability, DELTA, "plane")


def check_conventions(slip: str) -> dict[str, Any]:
    """Check the conventions of data with a slip or without."""
    data = simulate_measurements(HEXAPOD, 16)
    values = api.copy_measured(data)
    if slip == "unit":
        values[:, :3] *= 1e3
    elif slip == "sign":
        values[:, 5] *= -1.0
    elif slip == "order":
        values[:, [3, 4]] = values[:, [4, 3]]
    elif slip == "row":
        values[3, 3] += 0.05
    return api.report_conventions(api.robot(HEXAPOD), api.replace_measured(data, values))


for _slip in ("none", "unit", "sign", "order", "row"):
    add(f"arrival/{_slip}", check_conventions, _slip)
