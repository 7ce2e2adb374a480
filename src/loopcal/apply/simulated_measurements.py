# SPDX-License-Identifier: Apache-2.0
"""Simulate a calibration's measurements: draw a true machine, command poses, measure them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from loopcal.checks import check_choice
from loopcal.errors import DataError
from loopcal.measure import simulation
from loopcal.measure.data_checks import check_strokes, find_outside_strokes
from loopcal.measure.instrument import SIGMA, Gaussian, Instrument, Noise, Sensor, Uniform
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.kind import name_shared_error
from loopcal.measure.kinds.position import TargetKind
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import StatedValue
from loopcal.measure.readings import list_joint_dimensions
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import resolve_poses
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

DRAWN = 40  # number of poses that are drawn from the workspace where none are given


@dataclass(frozen=True, eq=False)
class SimulatedMeasurements:
    """Measurements of a simulated machine, that machine, and names of poses that were skipped."""

    data: Measurements
    truth: Mechanism
    skipped: tuple[str, ...] = ()


def simulate_measurements(
    robot: Mechanism,
    instrument: Instrument,
    poses: ArrayLike | int = DRAWN,
    *,
    draw_errors: bool = False,
    reading_sigma: ArrayLike | None = None,
    labels: Sequence[str] = (),
    places: Sequence[str] = (),
    seed: int = 1,
    skip_unreachable: bool = False,
) -> SimulatedMeasurements:
    """Command a robot to poses by its nominal geometry, and measure where the true machine goes.

    robot : its values are those of the true machine, its nominal values those of the controller.
    poses : (n, c) controlled coordinates [m, rad], or how many to draw from the workspace.
    draw_errors : draw the true machine from the spreads instead.
    reading_sigma : (a,) [SI] noise of the recorded readings; None as the robot states.
    labels : (n,) names of the poses, which are numbered without them.
    places : (n,) places of the poses such as `poses.csv:12`, for messages.
    skip_unreachable : leave out poses outside the reach or the strokes of the nominal or the true
        machine, and name them in the result. Poses without names keep their numbers.
    """
    truth = _choose_truth(robot, draw_errors, seed)
    targets = resolve_poses(truth.nominal, poses, seed)
    skipped: tuple[str, ...] = ()
    if skip_unreachable:
        commanded = inverse(truth.nominal, targets)
        _, state = simulation.reach_poses(truth, truth.values[None], commanded.q, commanded.state)
        reached = state.status[0] == Status.CONVERGED
        inside = ~find_outside_strokes(commanded.q, truth).any(axis=1)
        is_kept = commanded.converged & reached & inside
        numbers = labels or tuple(str(i + 1) for i in range(len(targets)))
        skipped = tuple(name for name, keep in zip(numbers, is_kept, strict=True) if not keep)
        if len(skipped) == len(targets):
            raise DataError(
                f"{robot.name} reaches none of {len(targets)} poses. Correct the poses or the "
                "strokes in the robot file"
            )
        if skipped:
            targets, kept = targets[is_kept], np.flatnonzero(is_kept).tolist()
            labels, places = [numbers[i] for i in kept], [places[i] for i in kept if places]
    names = (labels, places)
    data = simulation.simulate(
        truth, targets, instrument, seed, reading_sigma=reading_sigma, pose_names=names
    )
    if labels:
        data = replace(data, labels=tuple(labels))
    check_strokes(data, truth, places=places)
    return SimulatedMeasurements(data, truth, skipped)


def fill_in_measurements(
    robot: Mechanism,
    sheet: Measurements,
    instrument: Instrument,
    *,
    are_contacts: bool = False,
    draw_errors: bool = False,
    seed: int = 1,
) -> SimulatedMeasurements:
    """Simulate the measured values of a planned data sheet; of planes and lines alone the readings,
    which are those of the commanded poses in the sheet. The other arguments are as above.
    """
    truth = _choose_truth(robot, draw_errors, seed)
    if are_contacts:
        data = simulation.simulate_contacts(truth, sheet, instrument, seed)
        check_strokes(data, truth)
    else:
        data = simulation.replace_measured_values(truth, sheet, instrument, seed)
    return SimulatedMeasurements(data, truth)


def _choose_truth(robot: Mechanism, draw_errors: bool, seed: int) -> Mechanism:
    """Return a robot, or one whose values are drawn from its spreads."""
    return robot.with_values(simulation.sample_truth(robot, 1, seed)[0]) if draw_errors else robot


def predict_noise_free(
    robot: Mechanism,
    instrument: Instrument,
    poses: ArrayLike | int = DRAWN,
    *,
    reading_sigma: ArrayLike | None = None,
    labels: Sequence[str] = (),
    places: Sequence[str] = (),
    seed: int = 1,
) -> Measurements:
    """Return what an instrument would measure of the robot as it is, to analyze its data.

    poses : (n, c) controlled coordinates [m, rad], or how many to draw from the workspace.
    labels, places : (n,) names of the poses, and their places, for messages. seed : of the poses.
    """
    targets, names = resolve_poses(robot, poses, seed), (labels, places)
    return simulation.simulate(
        robot, targets, instrument, 0, robot, reading_sigma=reading_sigma, pose_names=names
    )


# A frame that may be unknown -> the names that kinds have for it.
FRAMES: Mapping[str, tuple[str, ...]] = {"base": ("frame",), "tool": ("tool", "targets")}
# Name of a distribution -> noise with given standard deviations (m,) [SI].
DISTRIBUTIONS: Mapping[str, Callable[[FloatArray], Noise]] = {
    "normal": Gaussian,
    "uniform": lambda sigma: Uniform(np.sqrt(3.0) * sigma),
}


@dataclass(frozen=True)
class InstrumentDescription:
    """What is known of an instrument before anything is measured."""

    kinds: Sequence[str] = ("pose",)  # names of kinds of measurement
    components: Sequence[str] = ()  # coordinates that the kind `component` measures
    joints: Sequence[str] = ()  # those that the kinds `joint` and `locked` measure
    orientation: str | None = None  # form of measured angles; None for the default of the kind
    # sigma_position, sigma_angle: standard deviations of each length [m] and angle [rad]
    sigma_position: float = SIGMA[Dimension.LENGTH]
    sigma_angle: float = SIGMA[Dimension.ANGLE]
    # standard deviation of a factor on all lengths that it measures, which is drawn; None for 1
    sigma_scale: float | None = None
    # of "base" (the frame of the instrument in the base) and "tool"
    unknown_frames: Sequence[str] = ()
    # names of targets on the platform whose places are unknown; none leaves the tool
    targets: Sequence[str] = ()
    # of simulated noise, one of DISTRIBUTIONS; both have the stated standard deviations. Uniform
    # noise lies within sqrt(3) of them
    distribution: str = "normal"


def build_instrument(
    description: InstrumentDescription, robot: Mechanism | None = None
) -> Instrument:
    """Return the instrument of a description; the robot tells which joints turn."""
    possible: dict[str, Any] = {"orientation": description.orientation}
    possible |= {key: tuple(getattr(description, key)) for key in ("components", "joints")}
    settings = {name: value for name, value in possible.items() if value}
    sigma = SIGMA | {
        Dimension.LENGTH: description.sigma_position,
        Dimension.ANGLE: description.sigma_angle,
    }
    sensors, stated = [], list[StatedValue]()
    for i, name in enumerate(description.kinds):
        check_choice("the kind of measurement", name, KINDS, DataError)
        if name in description.kinds[:i]:
            raise DataError(
                f"the kind {name!r} occurs twice. Name it once, and add the second one to the "
                "measurement file by hand"
            )
        fields = _setting_names(name)
        kind: Any = KINDS[name](**{k: v for k, v in settings.items() if k in fields})
        if robot is not None and isinstance(kind, JointSensor):
            known = list_joint_dimensions(robot)
            dimensions = [known[joint] for joint in kind.joints if joint in known]
            kind = replace(kind, measures=(*dimensions, kind.dimension)[0].value)
        if description.unknown_frames:
            kind = replace(kind, unknown=_name_unknown_frames(description.unknown_frames, kind))
        if description.targets and not isinstance(kind, TargetKind):
            able = ", ".join(name for name, known in KINDS.items() if issubclass(known, TargetKind))
            raise DataError(
                f"the kind {kind.name!r} measures no targets. Leave out the targets, or choose one "
                f"of {able}"
            )
        if description.targets:
            unknown = tuple(dict.fromkeys((*kind.unknown, "targets")))
            kind = replace(kind, targets=tuple(description.targets), unknown=unknown)
        columns = [column.dimension for column in kind.noise_columns]
        if description.sigma_scale is not None and Dimension.LENGTH in columns:
            kind = replace(kind, unknown=(*kind.unknown, "scale"))
            owned = name_shared_error(kind, "scale", "")
            stated.append(StatedValue(owned, description.sigma_scale))
        noise = np.array([sigma[dimension] for dimension in columns])
        sensors.append(Sensor(kind, DISTRIBUTIONS[description.distribution](noise)))
    for setting in settings:
        if not any(setting in _setting_names(name) for name in description.kinds):
            kinds = ",".join(description.kinds)
            raise DataError(
                f"the setting {setting!r} does not belong to the kind {kinds!r}. Remove it, or "
                "choose another kind"
            )
    if description.sigma_scale is not None and not stated:
        raise DataError("the instrument measures angles, which have no scale. Remove its sigma")
    return Instrument(tuple(sensors), tuple(stated))


def _setting_names(kind: str) -> set[str]:
    """Return the settings of a kind: the fields of its dataclass."""
    return {f.name for f in dataclasses.fields(cast(Any, KINDS[kind])) if f.init}


def _name_unknown_frames(frames: Sequence[str], kind: object) -> tuple[str, ...]:
    """Return the names that a kind has for unknown frames."""
    possible: tuple[str, ...] = getattr(kind, "allowed_unknown", ())
    names = []
    for frame in frames:
        check_choice("an unknown frame", frame, FRAMES, DataError)
        names_of_frame = [name for name in FRAMES[frame] if name in possible]
        if not names_of_frame:
            raise DataError(
                f"this kind of measurement has no {frame} frame that could be unknown. Remove it"
            )
        names.append(names_of_frame[0])
    return tuple(names)


def place_targets(instrument: Instrument, robot: Mechanism) -> Instrument:
    """Return the instrument with assumed places of unknown targets that state none.

    Several targets are evenly on a circle around the tool, in the xy plane of the platform; its
    radius is half of the robot's size, to two digits in its unit. One target is at the tool.
    """
    unit = find_unit(robot.units[Dimension.LENGTH]).factor_to_si
    radius = float(f"{robot.size / 2.0 / unit:.2g}")
    sensors = []
    for sensor in instrument.sensors:
        kind = sensor.kind
        if isinstance(kind, TargetKind) and "targets" in kind.unknown and len(kind.targets) > 1:
            angles = 2.0 * np.pi * np.arange(len(kind.targets)) / len(kind.targets)
            circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
            places = np.round(radius * circle, 1 if radius < 100.0 else 0) * unit
            kind = kind if kind.has_tool else replace(kind, places=places + robot.tool[:3, 3])
        sensors.append(replace(sensor, kind=kind))
    return replace(instrument, sensors=tuple(sensors))
