# SPDX-License-Identifier: Apache-2.0
"""The convention check names the interpretation that fits wrongly written data, and accepts
correct data of inaccurate robots.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from loopcal import geometry
from loopcal.diagnose.conventions import misfit
from loopcal.diagnose.conventions.convention_check import (
    IMPLAUSIBLE,
    ConventionCheck,
    check_conventions,
    compare_conventions,
)
from loopcal.diagnose.conventions.interpretations import (
    list_interpretations,
    list_reading_interpretations,
)
from loopcal.diagnose.conventions.misfit import ALLOWED, BETTER
from loopcal.errors import DataError, LoopcalError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.directions import Inclination
from loopcal.measure.kinds.distance import Distance
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Bearing, Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import ParameterTable
from loopcal.units import Dimension
from tests.zoo import load_cached_robot

SIGMA = {Dimension.LENGTH: 1e-5, Dimension.ANGLE: 5e-5, Dimension.PIXEL: 0.1}  # [m], [rad], [px]
FULL = Pose()
PAIR = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])


@cache
def simulate_data(
    name: str, kind: Kind, n: int = 10, times: float = 1.0, seed: int = 0
) -> Measurements:
    """Simulate a machine whose errors are `times` its spreads, commanded by nominal geometry."""
    robot, noise = (
        load_cached_robot(name),
        Gaussian(np.array([SIGMA[c.dimension] for c in kind.noise_columns])),
    )
    free = select_free_parameters(robot)
    truth = robot.values.copy()
    truth[free.places] += (
        times * free.tolerance * np.random.default_rng(seed).standard_normal(len(free))
    )
    targets = sample_workspace(robot, n, 1).coordinates
    return simulate(
        robot.with_values(truth),
        targets,
        Instrument((Sensor(kind, noise),)),
        seed,
        controller=robot,
    )


def change_values(data: Measurements, change) -> Measurements:
    """Apply `change` to the measured values of the first kind."""
    rows = data.observations[0]
    values = np.array(rows.measured)
    change(values)
    return replace(data, observations=(replace(rows, measured=values), *data.observations[1:]))


def scaled(columns, factor):
    def change(values):
        values[:, columns] *= factor

    return change


def swapped(a, b):
    def change(values):
        values[:, [a, b]] = values[:, [b, a]]

    return change


def change_orientation(convert):
    def change(values):
        values[:, :3] = convert(values[:, :3])

    return change


def zenith(values):
    values[:, 1::2] = 0.5 * np.pi - values[:, 1::2]


def left_handed(values):
    values[:, [1, 2]] *= -1.0  # a rotation vector is an axial vector
    values[:, 3] *= -1.0


def scalar_last(values):
    values[:, :4] = values[:, [1, 2, 3, 0]]


def list_slips(check: ConventionCheck) -> list[dict]:
    """Return the best interpretation and its alternatives as dictionaries."""
    best = () if check.interpretation is None else (check.interpretation,)
    return [
        {"slip": one.slip, **one.details, "source": one.source}
        for one in (*best, *check.alternatives)
    ]


def has_slip(check: ConventionCheck, slip: str, **details) -> bool:
    """Return whether this slip is among the interpretations."""
    wanted = {"slip": slip, **details}
    return any(wanted.items() <= one.items() for one in list_slips(check))


def unit_slip(quantity: str, factor, **more) -> dict:
    return {"slip": "unit", "quantity": quantity, "factor": factor, **more}


STATION = geometry.make_pose(np.eye(3), np.array([-1.5, -0.8, 0.1]))
XYZ = Pose("euler-xyz")
SEVERAL = Position(targets=("a", "b"), places=PAIR, unknown=("frame",))
SLIPS = {
    "milliradians written as radians": (
        "3-prs",
        FULL,
        scaled([0, 1, 2], 1e3),
        unit_slip("angles", 1e-3),
    ),
    "another Euler order": (
        "hexapod-42",
        XYZ,
        change_orientation(
            lambda a: geometry.matrix_to_euler(geometry.euler_to_matrix(a, "xyz"), "zyx")
        ),
        {"slip": "orientation-form", "form": "euler-zyx"},
    ),
    "moving for fixed axes": (
        "hexapod-42",
        XYZ,
        change_orientation(
            lambda a: geometry.matrix_to_euler(geometry.euler_to_matrix(a, "xyz"), "XYZ")
        ),
        {"slip": "orientation-form", "form": "euler-XYZ"},
    ),
    "a rotation vector for Euler angles": (
        "hexapod-42",
        XYZ,
        change_orientation(lambda a: geometry.log_so3(geometry.euler_to_matrix(a, "xyz"))),
        {"slip": "orientation-form", "form": "rotation-vector"},
    ),
    "scalar last": ("hexapod-42", Pose("quaternion"), scalar_last, {"slip": "scalar-last"}),
    "a left-handed frame": ("hexapod-42", FULL, left_handed, {"slip": "left-handed-frame"}),
    "one column in inches": ("hexapod-42", FULL, scaled([3], 1.0 / 25.4), unit_slip("x", 25.4)),
    "gon for degrees": (
        "hexapod-42",
        FULL,
        scaled([0, 1, 2], 10.0 / 9.0),
        unit_slip("angles", 0.9),
    ),
    "x and y swapped": (
        "linear-delta",
        Position(),
        swapped(0, 1),
        {"slip": "swapped-columns", "columns": ("x", "y")},
    ),
    "targets swapped": (
        "3-prs",
        Distance(targets=("a", "b"), places=PAIR, anchor=PAIR[0] * 9),
        swapped(0, 1),
        {"slip": "swapped-targets", "targets": ("a", "b")},
    ),
    "x and y of one of several targets swapped": (
        "hexapod-42",
        SEVERAL,
        swapped(3, 4),
        {"slip": "swapped-columns", "columns": ("b.x", "b.y")},
    ),
    "one column of one target negative": (
        "hexapod-42",
        SEVERAL,
        scaled([5], -1.0),
        {"slip": "sign", "column": "b.z"},
    ),
    "one column of one target in inches": (
        "hexapod-42",
        SEVERAL,
        scaled([3], 1.0 / 25.4),
        unit_slip("b.x", 25.4),
    ),
    "zenith angles": (
        "hexapod-42",
        Bearing(T_base_frame=STATION),
        zenith,
        {"slip": "zenith-angles"},
    ),
    "tilts swapped": (
        "3-prs",
        Inclination(unknown=("gravity",)),
        swapped(0, 1),
        {"slip": "swapped-columns", "columns": ("tilt_x", "tilt_y")},
    ),
    "sensors swapped": (
        "hexapod-42",
        JointSensor(joints=("q1", "q2", "q3")),
        swapped(0, 2),
        {"slip": "swapped-columns", "columns": ("q1", "q3")},
    ),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_wrong_convention_is_refused_and_the_right_one_is_named(slip) -> None:
    name, kind, change, expected = SLIPS[slip]
    data = change_values(simulate_data(name, kind), change)
    result = compare_conventions(load_cached_robot(name), data)
    assert result.is_refused, result
    assert has_slip(result, **expected), list_slips(result)
    assert result.misfit > IMPLAUSIBLE
    assert result.other_misfit < min(result.misfit / BETTER, ALLOWED)
    assert result.finding is not None
    assert result.finding.code == "conventions.other-interpretation"
    assert result.finding.data["is_consistent"]


def test_published_table_has_no_false_refusal_and_names_three_of_four_slips(root: Path) -> None:
    """Undetected slips change what the robot cannot do, such as the orientation of a delta."""
    tables = json.loads((root / "docs" / "evidence" / "conventions.json").read_text("utf-8"))[
        "tables"
    ]
    for times, count, silent, _, doubted, refused in tables["false_alarms"]["rows"]:
        assert count - silent >= 40
        assert refused == 0
        assert doubted == 0 or times > 3.0
    for name, count, doubted, refused, named in tables["detection"]["rows"]:
        assert count == 5
        assert doubted >= refused >= named >= (2 if ", and " in name else 3)  # two mistakes at once
    for _, count, doubted, refused in tables["random"]["rows"]:
        assert (doubted, refused) == (count, 0)
    assert sum(row[-1] for row in tables["detection"]["rows"]) >= 0.75 * 5 * len(
        tables["detection"]["rows"]
    )


@pytest.mark.parametrize(
    ("name", "factor", "far"), [("hexapod-42", 0.1, 0.01), ("linear-delta", 1e3, 0.0)]
)
def test_wrong_unit_is_named_although_two_rows_are_far_off_in_an_unknown_frame(
    name, factor, far
) -> None:
    """All lengths are in the wrong unit; two of twenty rows are 0.1 m off, or none."""
    data = simulate_data(name, Position(unknown=("frame",)), n=20)
    data = change_values(data, scaled(slice(None), factor))
    bad = change_values(
        data, lambda values: values.__setitem__((slice(3, 5), 0), values[3:5, 0] + far)
    )
    result = compare_conventions(load_cached_robot(name), bad)
    assert has_slip(result, **unit_slip("lengths", 1.0 / factor)), result


def test_outliers_alone_are_reported_but_not_refused() -> None:
    data = simulate_data("hexapod-42", Position(unknown=("frame",)), n=20)
    bad = change_values(
        data, lambda values: values.__setitem__((slice(3, 5), 0), values[3:5, 0] + 0.1)
    )
    result = compare_conventions(load_cached_robot("hexapod-42"), bad)
    assert not result.is_refused
    assert result.misfit < IMPLAUSIBLE  # without the two rows all is well
    assert result.finding is not None
    assert result.finding.code == "conventions.rows-far-off"
    assert result.finding.data == {"count": 2, "rows": 20, "poses": ("4", "5")}
    assert compare_conventions(load_cached_robot("hexapod-42"), data).finding is None


WITH_EVERY_KIND = ("3-prs",)


def list_cases(kinds):
    """Yield every shipped robot with the first kind, and one robot with all kinds."""
    for name in list_shipped_robots():
        if load_cached_robot(name).assembly.workspace:
            for kind in kinds if name in WITH_EVERY_KIND else kinds[:1]:
                yield name, kind


def test_correct_data_of_robots_three_tolerances_off_are_accepted() -> None:
    """No kind on any robot may even be doubtful."""
    known = [cls.examples()[0] for cls in KINDS.values()]
    count = 0
    for name, kind in list_cases(known):
        try:
            data = simulate_data(name, kind, times=3.0)
        except LoopcalError:
            continue  # this kind does not apply to this robot, or a pose is out of reach
        count += 1
        assert not compare_conventions(load_cached_robot(name), data).is_doubtful, (name, kind.name)
    assert count >= len(KINDS) + 6


@pytest.mark.parametrize("name", ["3-prs", "linear-delta"])
def test_correct_data_of_robots_forty_tolerances_off_are_doubtful_but_not_refused(name) -> None:
    """All interpretations are tried, and none fits far better."""
    data = simulate_data(name, Position(), times=40.0)
    result = compare_conventions(load_cached_robot(name), data)
    assert result.is_doubtful
    assert not result.is_refused
    assert result.finding is not None
    assert result.finding.code == "conventions.unexplained"


def test_small_heights_are_not_taken_for_a_wrong_unit() -> None:
    """Every unit that shrinks the heights fits better, but so does a constant."""
    robot = load_cached_robot("linear-delta")
    flat = np.column_stack([np.random.default_rng(0).uniform(-0.05, 0.05, (20, 2)), np.zeros(20)])
    noise = Gaussian(np.array([1e-6]))
    free = select_free_parameters(robot)
    truth = robot.values.copy()
    truth[free.places] += (
        40.0 * free.tolerance * np.random.default_rng(1).standard_normal(len(free))
    )
    data = simulate(
        robot.with_values(truth),
        flat,
        Instrument((Sensor(Component(("z",)), noise),)),
        0,
        controller=robot,
    )
    result = compare_conventions(robot, data)
    assert result.is_doubtful
    assert not result.is_refused, result


def test_random_data_are_not_refused_and_cost_at_most_two_thorough_linearizations(
    monkeypatch,
) -> None:
    """Random positions in an unknown frame: no interpretation is promising enough to linearize."""
    data = simulate_data("linear-delta", Position(unknown=("frame",)), n=40)
    noise = 0.02 * np.random.default_rng(0).standard_normal(
        (40, 3)
    )  # [m], as far as the machine moves
    data = change_values(data, lambda values: values.__iadd__(noise))
    poses: list[int] = []
    linearize = misfit._linearize

    def counted(problem, data, effort, start):
        if effort == misfit.THOROUGH:
            poses.append(data.n_poses)
        return linearize(problem, data, effort, start)

    monkeypatch.setattr(misfit, "_linearize", counted)
    result = compare_conventions(load_cached_robot("linear-delta"), data)
    assert result.misfit > 100.0
    assert not result.is_refused
    assert len(poses) <= 2  # the data as written, before and after far rows were excluded


def test_instrument_in_the_wrong_unit_is_named_among_two() -> None:
    robot, at = (
        load_cached_robot("hexapod-42"),
        sample_workspace(load_cached_robot("hexapod-42"), 10, 1).coordinates,
    )
    sensors = (
        Sensor(Position(), Gaussian(np.full(3, 1e-5))),
        Sensor(Inclination(), Gaussian(np.full(2, 5e-5))),
    )
    data = simulate(robot, at, Instrument(sensors), 0)
    tracker, level = data.observations
    level = replace(level, measured=level.measured * np.pi / 180.0)
    result = compare_conventions(robot, replace(data, observations=(tracker, level)))
    expected = unit_slip("angles", pytest.approx(180.0 / np.pi), source="kind 'inclination'")
    assert expected.items() <= list_slips(result)[0].items()


def test_file_in_the_wrong_unit_is_named_among_two_of_one_kind() -> None:
    robot, data = load_cached_robot("linear-delta"), simulate_data("linear-delta", Position(), n=16)
    rows = data.observations[0]
    parts = (
        replace(rows.take(np.arange(8)), source="a.csv"),
        replace(rows.take(np.arange(8, 16)), source="b.csv"),
    )
    inches = replace(parts[1], measured=parts[1].measured / 25.4)
    result = compare_conventions(robot, replace(data, observations=(parts[0], inches)))
    assert unit_slip("lengths", 25.4, source="b.csv").items() <= list_slips(result)[0].items()
    readings = np.concatenate([data.readings[:8], 0.1 * data.readings[8:]])
    result = compare_conventions(robot, replace(data, observations=parts, readings=readings))
    assert unit_slip("readings", 10.0, source="b.csv").items() <= list_slips(result)[0].items()
    nameless = tuple(replace(part, source="") for part in parts)
    unnamed = list_reading_interpretations(replace(data, observations=nameless), robot.actuators)
    assert ("part 2 of the data", 10.0) in {
        (one.source, one.details.get("factor")) for one in unnamed
    }


def test_missing_values_and_fixed_parameters_do_not_change_the_convention_check() -> None:
    robot, data = load_cached_robot("linear-delta"), simulate_data("linear-delta", Position())
    wrong = change_values(data, scaled([0, 1, 2], 1e3))
    fixed = replace(
        robot,
        parameters=ParameterTable(tuple(replace(p, free=False) for p in robot.parameters.entries)),
    )
    holes = (slice(None, None, 2), 1)
    readings, sigma = np.array(data.readings), np.zeros_like(data.readings)
    readings[0, 0], sigma[0, 0] = np.nan, np.inf
    for machine, some, slip in (
        (fixed, data, False),
        (fixed, wrong, True),
        (robot, change_values(data, lambda values: values.__setitem__(holes, np.nan)), False),
        (robot, change_values(wrong, lambda values: values.__setitem__(holes, np.nan)), True),
        (robot, replace(data, readings=readings, reading_sigma=sigma), False),
    ):
        result = compare_conventions(machine, some)
        assert result.is_refused == slip
        assert has_slip(result, **unit_slip("lengths", 1e-3)) == slip
    for nothing in (data.with_weights(np.zeros(10)), replace(data, observations=())):
        assert np.isnan(compare_conventions(robot, nothing).misfit)


def test_shifted_rows_are_detected_in_large_data() -> None:
    data = simulate_data("linear-delta", Position(), n=200)
    result = compare_conventions(
        load_cached_robot("linear-delta"), replace(data, readings=np.roll(data.readings, 1, axis=0))
    )
    assert has_slip(result, "shifted-readings", neighbor="below")


@pytest.mark.slow
def test_wrong_unit_of_readings_is_named_when_no_pose_is_reachable() -> None:
    data = simulate_data("linear-delta", Position(), n=4)
    result = compare_conventions(
        load_cached_robot("linear-delta"), replace(data, readings=data.readings * 1e3)
    )
    assert result.finding is not None
    assert (result.finding.data["reached"], result.finding.data["poses"]) == (0, 4)
    assert has_slip(result, "unit", quantity="readings")


@pytest.mark.slow
def test_published_hexapod_table_is_refused_in_its_printed_euler_order() -> None:
    """The hexapod study prints Rz(a) Ry(b) Rx(c), but its Table 4 was computed with the opposite
    order.
    """
    from loopcal.measure.observations import Observations
    from loopcal.papers.hexapod_42 import results as steps

    setup, printed = steps.make_setup(), steps.PRINTED.table("table_4", "PP")
    robot, values = setup.robot, printed.values / steps.TO_PRINTED
    sigma = printed.unit / steps.TO_PRINTED / np.sqrt(12.0)
    right = steps.to_measurements(setup, values, sigma)
    assert not compare_conventions(robot, right).is_refused
    kind = Pose(f"euler-{steps.PRINTED.find('rotation', 'order')}").with_tool(robot.tool)
    rows = Observations.from_sigma(
        kind, np.arange(len(values)), np.roll(values, 3, axis=1), np.roll(sigma, 3, axis=1)
    )
    result = compare_conventions(robot, replace(right, observations=(rows,)))
    assert has_slip(result, "orientation-form", form=f"euler-{steps.ORDER}")
    assert result.misfit > 100.0 * result.other_misfit


def test_refusal_has_the_code_of_its_finding_and_can_be_overridden() -> None:
    robot = load_cached_robot("hexapod-42")
    data = change_values(simulate_data("hexapod-42", FULL), scaled([3, 4, 5], 1e3))
    with pytest.raises(DataError, match="the unit in the header") as error:
        check_conventions(robot, data)
    assert error.value.code == "conventions.other-interpretation"
    assert np.isnan(check_conventions(robot, data, allow_implausible=True).misfit)
    still = change_values(
        simulate_data("hexapod-42", Position()),
        lambda values: values.__setitem__(slice(1, None), values[0]),
    )
    with pytest.raises(DataError, match="never moves: its readings stay within 0 mm") as error:
        check_conventions(robot, still)
    assert error.value.code == "conventions.target-never-moves"


def test_every_interpretation_changes_the_values_and_keeps_their_shape() -> None:
    seen: set[str] = set()
    for cls in KINDS.values():
        for kind in cls.examples()[:2]:
            try:
                data = simulate_data("hexapod-42", kind, n=5)
            except LoopcalError:
                continue
            for way in list_interpretations(data):
                rows = way.apply(data).observations[0]
                assert rows.measured.shape == data.observations[0].measured.shape
                assert not np.allclose(
                    rows.measured, data.observations[0].measured, rtol=1e-12, atol=0.0
                )
            seen.add(kind.name)
    assert seen == set(KINDS) - {"closure"}, "a hexapod has no redundant readings"
    data, robot = simulate_data("linear-delta", Position(), n=5), load_cached_robot("linear-delta")
    ways = [
        (way.slip, *way.details.items())
        for way in list_reading_interpretations(data, robot.actuators)
    ]
    # units of all and each, signs of all and each, orders, gear factors of all and each, rows
    assert len(set(ways)) == len(ways) == 4 * 6 + 4 + 5 + 4 * 4 + 2
