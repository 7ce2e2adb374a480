# SPDX-License-Identifier: Apache-2.0
"""Conventions: slips are named by what fits instead, and true data pass, however far the robot is
off.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from loopcal import geometry
from loopcal.diagnose.conventions import (
    IMPLAUSIBLE,
    ConventionCheck,
    check_conventions,
    compare_conventions,
    list_interpretations,
    list_reading_interpretations,
    misfit,
)
from loopcal.diagnose.conventions.selection import ALLOWED, BETTER
from loopcal.errors import DataError, LoopcalError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.io import load_robot
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.measure import (
    KINDS,
    Bearing,
    Component,
    Distance,
    Gaussian,
    Inclination,
    Instrument,
    JointSensor,
    Kind,
    Measurements,
    Pose,
    Position,
    Sensor,
    simulate,
)
from loopcal.mechanism import sample_workspace
from loopcal.parameters import ParameterTable
from loopcal.units import Dimension

SIGMA = {Dimension.LENGTH: 1e-5, Dimension.ANGLE: 5e-5}  # [m], [rad]
FULL = Pose()
PAIR = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])


@cache
def robot_of(name: str):
    return load_robot(name)


@cache
def measured(name: str, kind: Kind, n: int = 10, times: float = 1.0, seed: int = 0) -> Measurements:
    """What a machine `times` its tolerances off shows, commanded by its nominal geometry."""
    robot, noise = (
        robot_of(name),
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


def changed(data: Measurements, change) -> Measurements:
    """The data with other values of their first kind."""
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


def turned(convert):
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


def slips(check: ConventionCheck) -> list[dict]:
    """The best interpretation and its alternatives, as kind of the slip and data."""
    best = () if check.interpretation is None else (check.interpretation,)
    return [
        {"slip": one.slip, **one.details, "source": one.source}
        for one in (*best, *check.alternatives)
    ]


def has_slip(check: ConventionCheck, slip: str, **details) -> bool:
    """Whether this slip is among the interpretations."""
    wanted = {"slip": slip, **details}
    return any(wanted.items() <= one.items() for one in slips(check))


def times(quantity: str, factor, **more) -> dict:
    return {"slip": "unit", "quantity": quantity, "factor": factor, **more}


STATION = geometry.make_pose(np.eye(3), np.array([-1.5, -0.8, 0.1]))
XYZ = Pose("euler-xyz")
SLIPS = {
    "milliradians written as radians": (
        "3-prs",
        FULL,
        scaled([0, 1, 2], 1e3),
        times("angles", 1e-3),
    ),
    "another Euler order": (
        "hexapod-42",
        XYZ,
        turned(lambda a: geometry.matrix_to_euler(geometry.euler_to_matrix(a, "xyz"), "zyx")),
        {"slip": "orientation-form", "form": "euler-zyx"},
    ),
    "moving for fixed axes": (
        "hexapod-42",
        XYZ,
        turned(lambda a: geometry.matrix_to_euler(geometry.euler_to_matrix(a, "xyz"), "XYZ")),
        {"slip": "orientation-form", "form": "euler-XYZ"},
    ),
    "a rotation vector for Euler angles": (
        "hexapod-42",
        XYZ,
        turned(lambda a: geometry.log_so3(geometry.euler_to_matrix(a, "xyz"))),
        {"slip": "orientation-form", "form": "rotation-vector"},
    ),
    "scalar last": ("hexapod-42", Pose("quaternion"), scalar_last, {"slip": "scalar-last"}),
    "a left-handed frame": ("hexapod-42", FULL, left_handed, {"slip": "left-handed-frame"}),
    "one column in inches": ("hexapod-42", FULL, scaled([3], 1.0 / 25.4), times("x", 25.4)),
    "gon for degrees": ("hexapod-42", FULL, scaled([0, 1, 2], 10.0 / 9.0), times("angles", 0.9)),
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
def test_a_slip_is_refused_with_what_fits_instead(slip) -> None:
    name, kind, change, expected = SLIPS[slip]
    data = changed(measured(name, kind), change)
    found = compare_conventions(robot_of(name), data)
    assert found.is_refused, found
    assert has_slip(found, **expected), slips(found)
    assert found.misfit > IMPLAUSIBLE
    assert found.other_misfit < min(found.misfit / BETTER, ALLOWED)
    assert found.finding is not None
    assert found.finding.code == "conventions.other-interpretation"
    assert found.finding.data["is_consistent"]


READINGS = {
    "actuators swapped": (
        "hexapod-42",
        lambda q: q[:, [1, 0, 2, 3, 4, 5]],
        {"slip": "swapped-readings", "actuators": ("q1", "q2")},
    ),
    "drop for rise": (
        "linear-delta",
        lambda q: -q,
        {"slip": "reading-sign", "actuators": ("q1", "q2", "q3")},
    ),
    "rows moved by one": (
        "linear-delta",
        lambda q: np.roll(q, 1, axis=0),
        {"slip": "shifted-readings", "neighbor": "below"},
    ),
}


@pytest.mark.parametrize("slip", READINGS)
def test_a_slip_of_the_readings_is_refused_with_what_fits_instead(slip) -> None:
    name, change, expected = READINGS[slip]
    data = measured(name, Position())
    found = compare_conventions(robot_of(name), replace(data, readings=change(data.readings)))
    assert expected.items() <= slips(found)[0].items(), found


def test_at_full_size_no_true_data_are_refused_and_slips_are_named_wherever_they_are_seen(
    root: Path,
) -> None:
    """Slips that leave the data plausible change what the robot does not do: the orientation of a
    delta.
    """
    tables = json.loads((root / "docs" / "evidence" / "conventions.json").read_text("utf-8"))[
        "tables"
    ]
    for times, count, silent, _, doubted, refused in tables["false_alarms"]["rows"]:
        assert count - silent >= 40
        assert refused == 0
        assert doubted == 0 or times > 3.0
    for _, count, doubted, refused, named in tables["detection"]["rows"]:
        assert count == 5
        assert doubted >= refused >= named >= 3
    assert sum(row[-1] for row in tables["detection"]["rows"]) >= 0.75 * 5 * len(
        tables["detection"]["rows"]
    )


def test_a_slip_is_seen_through_blunders() -> None:
    """Two of twenty rows are 0.1 m off, and all lengths are in the wrong unit."""
    data = changed(
        measured("hexapod-42", Position(unknown=("frame",)), n=20), scaled(slice(None), 0.1)
    )
    bad = changed(data, lambda values: values.__setitem__((slice(3, 5), 0), values[3:5, 0] + 0.01))
    found = compare_conventions(robot_of("hexapod-42"), bad)
    assert has_slip(found, **times("lengths", 10.0)), found


def test_a_unit_is_named_where_a_constant_in_its_place_leaves_no_frame_to_be_found() -> None:
    data = changed(
        measured("linear-delta", Position(unknown=("frame",)), n=20), scaled(slice(None), 1e3)
    )
    found = compare_conventions(robot_of("linear-delta"), data)
    assert has_slip(found, **times("lengths", 1e-3)), found


def test_blunders_alone_are_left_to_their_own_check() -> None:
    data = measured("hexapod-42", Position(unknown=("frame",)), n=20)
    bad = changed(data, lambda values: values.__setitem__((slice(3, 5), 0), values[3:5, 0] + 0.1))
    found = compare_conventions(robot_of("hexapod-42"), bad)
    assert not found.is_refused
    assert found.misfit < IMPLAUSIBLE  # without the two rows all is well
    assert found.finding is not None
    assert found.finding.code == "conventions.rows-far-off"
    assert found.finding.data == {"count": 2, "rows": 20, "poses": ("4", "5")}
    assert compare_conventions(robot_of("hexapod-42"), data).finding is None


WITH_EVERY_KIND = ("3-prs",)


def every_case(kinds):
    """Every shipped robot with the first kind, one of them with all."""
    for name in list_shipped_robots():
        if robot_of(name).assembly.workspace:
            for kind in kinds if name in WITH_EVERY_KIND else kinds[:1]:
                yield name, kind


def test_true_data_of_robots_three_times_beyond_their_tolerances_pass() -> None:
    """No draw may be refused; the misfit stays below the threshold but for angles that mean nothing
    near zero tilt.
    """
    known = [cls.examples()[0] for cls in KINDS.values()]
    count = 0
    for name, kind in every_case(known):
        try:
            data = measured(name, kind, times=3.0)
        except LoopcalError:
            continue  # this kind has nothing to look at on this robot, or the robot cannot follow
        count += 1
        assert not compare_conventions(robot_of(name), data).is_doubtful, (name, kind.name)
    assert count >= len(KINDS) + 6


@pytest.mark.parametrize("name", ["3-prs", "linear-delta"])
def test_true_data_of_a_robot_far_off_its_tolerances_are_not_refused(name) -> None:
    """Forty tolerances off: implausible, all others are tried, and none fits far better."""
    data = measured(name, Position(), times=40.0)
    found = compare_conventions(robot_of(name), data)
    assert found.is_doubtful
    assert not found.is_refused
    assert found.finding is not None
    assert found.finding.code == "conventions.unexplained"


def test_heights_that_should_be_zero_are_no_evidence_of_a_unit() -> None:
    """Every unit that makes them smaller fits better: a constant does so as well, and nothing is
    refused.
    """
    robot = robot_of("linear-delta")
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
    found = compare_conventions(robot, data)
    assert found.is_doubtful
    assert not found.is_refused, found


def test_data_of_nothing_are_noted_after_few_readings_were_judged(monkeypatch) -> None:
    """Positions drawn at random in an unknown frame: all other ways are compared, none promises
    anything, none is judged.
    """
    data = measured("linear-delta", Position(unknown=("frame",)), n=40)
    noise = 0.02 * np.random.default_rng(0).standard_normal(
        (40, 3)
    )  # [m], as far as the machine moves
    data = changed(data, lambda values: values.__iadd__(noise))
    poses: list[int] = []
    linearize = misfit._linearize

    def counted(problem, data, effort, start):
        if effort == misfit.THOROUGH:
            poses.append(data.n_poses)
        return linearize(problem, data, effort, start)

    monkeypatch.setattr(misfit, "_linearize", counted)
    found = compare_conventions(robot_of("linear-delta"), data)
    assert found.misfit > 100.0
    assert not found.is_refused
    assert len(poses) <= 2  # the data as written, before and after far rows were excluded


def test_too_few_rows_say_nothing() -> None:
    data = changed(
        measured("hexapod-42", Position(unknown=("frame",)), n=4), scaled([0, 1, 2], 1e3)
    )
    found = compare_conventions(robot_of("hexapod-42"), data)
    assert np.isnan(found.misfit)
    assert not found.is_refused


def test_of_two_joined_instruments_the_one_in_the_wrong_unit_is_named() -> None:
    robot, at = robot_of("hexapod-42"), sample_workspace(robot_of("hexapod-42"), 10, 1).coordinates
    sensors = (
        Sensor(Position(), Gaussian(np.full(3, 1e-5))),
        Sensor(Inclination(), Gaussian(np.full(2, 5e-5))),
    )
    data = simulate(robot, at, Instrument(sensors), 0)
    tracker, level = data.observations
    level = replace(level, measured=level.measured * np.pi / 180.0)
    found = compare_conventions(robot, replace(data, observations=(tracker, level)))
    expected = times("angles", pytest.approx(180.0 / np.pi), source="kind 'inclination'")
    assert expected.items() <= slips(found)[0].items()


def test_of_two_files_of_one_kind_the_one_that_is_written_otherwise_is_named() -> None:
    robot, data = robot_of("linear-delta"), measured("linear-delta", Position(), n=16)
    rows = data.observations[0]
    parts = (
        replace(rows.take(np.arange(8)), source="a.csv"),
        replace(rows.take(np.arange(8, 16)), source="b.csv"),
    )
    inches = replace(parts[1], measured=parts[1].measured / 25.4)
    found = compare_conventions(robot, replace(data, observations=(parts[0], inches)))
    assert times("lengths", 25.4, source="b.csv").items() <= slips(found)[0].items()
    readings = np.concatenate([data.readings[:8], 0.1 * data.readings[8:]])
    found = compare_conventions(robot, replace(data, observations=parts, readings=readings))
    assert times("readings", 10.0, source="b.csv").items() <= slips(found)[0].items()
    nameless = tuple(replace(part, source="") for part in parts)
    unnamed = list_reading_interpretations(replace(data, observations=nameless), robot.actuators)
    assert ("part 2 of the data", 10.0) in {
        (one.source, one.details.get("factor")) for one in unnamed
    }


def test_what_is_absent_fixed_or_unread_neither_hides_a_slip_nor_looks_like_one() -> None:
    robot, data = robot_of("linear-delta"), measured("linear-delta", Position())
    wrong = changed(data, scaled([0, 1, 2], 1e3))
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
        (robot, changed(data, lambda values: values.__setitem__(holes, np.nan)), False),
        (robot, changed(wrong, lambda values: values.__setitem__(holes, np.nan)), True),
        (robot, replace(data, readings=readings, reading_sigma=sigma), False),
    ):
        found = compare_conventions(machine, some)
        assert found.is_refused == slip
        assert has_slip(found, **times("lengths", 1e-3)) == slip
    for nothing in (data.with_weights(np.zeros(10)), replace(data, observations=())):
        assert np.isnan(compare_conventions(robot, nothing).misfit)


def test_large_data_are_judged_by_runs_of_neighbours_and_rows_one_off_are_seen_in_them() -> None:
    data = measured("linear-delta", Position(), n=200)
    found = compare_conventions(
        robot_of("linear-delta"), replace(data, readings=np.roll(data.readings, 1, axis=0))
    )
    assert has_slip(found, "shifted-readings", neighbor="below")


@pytest.mark.slow
def test_readings_that_the_robot_cannot_reach_are_explained() -> None:
    data = measured("linear-delta", Position(), n=4)
    found = compare_conventions(
        robot_of("linear-delta"), replace(data, readings=data.readings * 1e3)
    )
    assert found.finding is not None
    assert (found.finding.data["reached"], found.finding.data["poses"]) == (0, 4)
    assert has_slip(found, "unit", quantity="readings")


@pytest.mark.slow
def test_the_published_table_names_its_own_euler_order() -> None:
    """The hexapod study prints Rz(a) Ry(b) Rx(c), but its Table 4 was made with the angles in the
    opposite order.
    """
    from loopcal.measure import Observations
    from loopcal.papers.hexapod_42.published import MM, load_nominal_machine, read_published
    from loopcal.papers.hexapod_42.steps import ORDER, Study, to_measurements
    from loopcal.papers.hexapod_42.study import round_to_degrees
    from loopcal.papers.hexapod_42.verdicts import TO_PRINTED

    printed, robot = read_published(), load_nominal_machine()
    study = Study(robot, robot, round_to_degrees(printed.nominal_poses), ORDER)
    values = printed.measured_poses.values / TO_PRINTED
    sigma = printed.measured_poses.unit * np.array([MM] * 3 + [1.0] * 3) / np.sqrt(12.0)
    right = to_measurements(study, values, sigma)
    assert not compare_conventions(robot, right).is_refused
    kind = Pose(f"euler-{printed.order}").with_tool(robot.tool)
    rows = Observations.from_sigma(
        kind, np.arange(len(values)), np.roll(values, 3, axis=1), np.roll(sigma, 3, axis=1)
    )
    found = compare_conventions(robot, replace(right, observations=(rows,)))
    assert has_slip(found, "orientation-form", form=f"euler-{ORDER}")
    assert found.misfit > 100.0 * found.other_misfit


def test_the_error_has_the_code_of_the_finding_and_can_be_overridden() -> None:
    robot = robot_of("hexapod-42")
    data = changed(measured("hexapod-42", FULL), scaled([3, 4, 5], 1e3))
    with pytest.raises(DataError, match="the unit in the header") as error:
        check_conventions(robot, data)
    assert error.value.code == "conventions.other-interpretation"
    assert np.isnan(check_conventions(robot, data, allow_implausible=True).misfit)
    still = changed(
        measured("hexapod-42", Position()),
        lambda values: values.__setitem__(slice(1, None), values[0]),
    )
    with pytest.raises(DataError, match="never moves: its readings stay within 0 mm") as error:
        check_conventions(robot, still)
    assert error.value.code == "conventions.target-never-moves"


def test_every_hypothesis_is_another_reading_in_the_same_shape() -> None:
    seen: set[str] = set()
    for cls in KINDS.values():
        for kind in cls.examples()[:2]:
            try:
                data = measured("hexapod-42", kind, n=5)
            except LoopcalError:
                continue
            for way in list_interpretations(data):
                rows = way.apply(data).observations[0]
                assert rows.measured.shape == data.observations[0].measured.shape
                assert not np.allclose(
                    rows.measured, data.observations[0].measured, rtol=1e-12, atol=0.0
                )
                assert way.shrinks == (way.details.get("factor", 1.0) < 1.0)
            seen.add(kind.name)
    assert seen == set(KINDS)
    data, robot = measured("linear-delta", Position(), n=5), robot_of("linear-delta")
    ways = [
        (way.slip, *way.details.items())
        for way in list_reading_interpretations(data, robot.actuators)
    ]
    assert len(set(ways)) == len(ways) == 6 + 1 + 3 + 3 + 1 + 2  # units, signs, pairs, order, rows
