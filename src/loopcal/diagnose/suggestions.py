# SPDX-License-Identifier: Apache-2.0
"""Suggest further measurements that determine what the data leave open, by testing every kind.

With a basis B (d, p) of the unidentifiable combinations, in tolerances, and the triangular factor X
of the rows of a further instrument (its nuisance parameters eliminated), the null space of X B'
stays open. A combination is determined when no direction of that null space has a part in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal.diagnose.gauge_freedoms import probe_workspace
from loopcal.diagnose.identifiable_parameters import (
    Identifiability,
    compute_remaining_sd,
    identifiability,
)
from loopcal.errors import DataError, MechanismError
from loopcal.estimate.information import ObservedPoses, instrument_factor, observe_poses
from loopcal.estimate.null_space import Combination, sparsify_basis
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import list_names
from loopcal.measure.array_checks import check_type
from loopcal.measure.instrument import Gaussian, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.joints import Closure, JointSensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.units import Dimension

POSES = 24  # number of poses of a further measurement
# Singular value above which an instrument observes a direction, relative to the largest of its
# rows and of those that exist.
OBSERVED = 1e-8
# A further measurement must reduce the remaining uncertainty of the leading parameter below this
# share.
IMPROVEMENT = 0.9
MOST_MISSING = 3  # largest number of open combinations that a refusal lists

TILT = "tilt-torsion"
# Single coordinates, the simplest further measurements.
SINGLE = (("x",), ("y",), ("z",), ("psi",), ("theta",), ("phi", "theta"))
# Standard deviations [SI] of a further instrument where none are stated.
SIGMA = {Dimension.LENGTH: 1e-5, Dimension.ANGLE: 5e-5, Dimension.RATIO: 5e-5}


@dataclass(frozen=True)
class FurtherMeasurement:
    """A further measurement that determines a combination."""

    words: str  # what is measured, such as `psi`
    kind: str  # its kind
    # standard deviation of the first parameter of the combination over its tolerance, from the
    # data, the further measurement and the tolerances together
    left: float


@dataclass(frozen=True, eq=False)
class MeasurementSuggestion(Result):
    """An unidentifiable combination, and the measurements that determine it, simplest first."""

    combination: Combination
    measurements: tuple[FurtherMeasurement, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        names="combination.names", cures="measurements", finding="finding"
    )

    @property
    def finding(self) -> Finding:
        """The suggestion: a further measurement, or fixing a parameter."""
        names = self.combination.names
        if not self.measurements:
            return report_finding("identifiability.fix-one", names=names)
        measurements = tuple(dict(vars(measurement)) for measurement in self.measurements)
        return report_finding(
            "identifiability.measure-also", names=names, measurements=measurements, poses=POSES
        )

    def __str__(self) -> str:
        return str(self.finding)


def suggest_measurements(
    identifiability: Identifiability, sigma: dict[Dimension, float] | None = None
) -> tuple[MeasurementSuggestion, ...]:
    """Test every kind of measurement, one after the other, on the unidentifiable combinations.

    sigma : standard deviations of the further instrument by dimension [SI].
    Returns one suggestion for each of `identifiability.unidentifiable`, in order.
    """
    check_type(
        identifiability, Identifiability, "identifiability", "as from identifiability(robot, data)"
    )
    if sigma is not None:
        check_type(sigma, dict, "sigma", "such as {Dimension.LENGTH: 1e-5} [SI]")
    combinations, factor = identifiability.unidentifiable, identifiability.factor
    if not combinations:
        return ()
    free = identifiability.free_parameters
    B = sparsify_basis(identifiability.null_space())
    B = B / np.linalg.norm(B, axis=1, keepdims=True)
    leading = [free.names.index(c.names[0]) for c in combinations]
    measurements: list[list[FurtherMeasurement]] = [[] for _ in leading]
    # an observed direction must exceed the rounding of the existing rows, too
    root, floor = free.correlation_root(), float(np.linalg.norm(factor, ord=2))
    present = compute_remaining_sd(factor, root)
    joints = [
        (f"{limb.name}.{joint.name}", "length" if joint.kind == "P" else "angle")
        for limb, joint in free.robot.assembly.passive_joints
    ]
    names = [name for name, _ in joints]
    try:
        q = sample_workspace(free.robot, POSES, seed=0).solution.q
        scene = observe_poses(free, q, names)
    except MechanismError:  # no stated workspace
        scene = probe_workspace(free, names)
    for words, kind in _list_candidates(free.robot, joints):
        try:
            seen = _measure_at(scene, kind, SIGMA | (sigma or {}))
            X = instrument_factor(scene, seen)[0, :-1, :-1]
        except DataError:
            continue  # this kind has nothing to measure on this robot
        # combinations that the rows X separate from all others
        _, s, vt = np.linalg.svd(X @ B.T)
        largest = max(float(np.linalg.norm(X, ord=2)), floor)
        undetermined = vt[s <= OBSERVED * largest] if largest > 0.0 else vt
        determined = np.asarray(np.linalg.norm(undetermined, axis=0) <= np.sqrt(OBSERVED))
        if determined.any():
            left = compute_remaining_sd(np.concatenate([factor, X]), root)
            better = determined & (left[leading] < IMPROVEMENT * present[leading])
            for i in np.flatnonzero(better):
                measurement = FurtherMeasurement(words, kind.name, float(left[leading[i]]))
                measurements[i].append(measurement)
    pairs = zip(combinations, measurements, strict=True)
    return tuple(MeasurementSuggestion(combination, tuple(chosen)) for combination, chosen in pairs)


def describe_missing_equations(robot: Mechanism, data: Measurements) -> Finding | None:
    """Return what too few equations leave open and what determines it, for a refusal; None where
    more than a few combinations are open.
    """
    if int(robot.parameters.free.sum()) - data.n_rows > MOST_MISSING:
        return None
    suggestions = suggest_measurements(identifiability(robot, data))
    if not 0 < len(suggestions) <= MOST_MISSING:
        return None
    common = [
        words
        for words in (measurement.words for measurement in suggestions[0].measurements)
        if all(words in {m.words for m in other.measurements} for other in suggestions)
    ]
    return report_finding(
        "identifiability.missing-equations",
        combinations=tuple(dict(s.combination.finding.data) for s in suggestions),
        measurement=common[0] if common else None,
    )


def _list_candidates(robot: Mechanism, joints: list[tuple[str, str]]) -> Iterator[tuple[str, Kind]]:
    """Yield measurements with their descriptions, the simplest first: without a frame, single
    coordinates, other kinds, joints.
    """
    # examples of Component and JointSensor belong to one robot; both are made for this one
    known = [
        kind for kind in KINDS.values() if not issubclass(kind, (Closure, Component, JointSensor))
    ]
    yield from _list_examples([kind for kind in known if kind.poses_per_row > 1])
    for names in SINGLE:
        yield " and ".join(names), Component(names, None if names[0] in "xyz" else TILT)
    yield from _list_examples([kind for kind in known if kind.poses_per_row == 1])
    for name, measures in joints:
        yield f"the joint {name}", JointSensor(joints=(name,), measures=measures)


def _list_examples(kinds: Iterable[type[Kind]]) -> Iterator[tuple[str, Kind]]:
    """Yield examples of kinds whose descriptions differ."""
    listed: set[str] = set()
    for kind in (example for cls in kinds for example in cls.examples()):
        targets, unknown = getattr(kind, "targets", ()), list(kind.setup_items)
        words = kind.description
        if unknown or not words:
            words = f"the {kind.name}" + (f" of {len(targets)} targets" if len(targets) > 1 else "")
        if unknown:
            words = f"{words} ({list_names(unknown)} unknown)"
        if words not in listed:
            listed.add(words)
            yield words, kind


def _measure_at(scene: ObservedPoses, kind: Kind, sigma: dict[Dimension, float]) -> Measurements:
    """Return noiseless measurements of a kind at the scene."""
    robot = scene.free.robot
    noise = Gaussian(np.array([sigma[column.dimension] for column in kind.noise_columns]))
    sensor = Sensor(kind.with_tool(robot.tool), noise).assign_rows(len(scene.readings))
    rows, mounted = sensor.rows, sensor.kind
    assert rows is not None
    sensed = kind.stack_joints(scene.joints, rows)
    zero = np.zeros((1, len(rows), len(kind.noise_columns)))
    measured = mounted.measure(scene.T[:, rows], zero, None, sensed)[0]
    observations = Observations.from_sigma(
        mounted, rows, measured, noise.sigma, sensor.session, sensor.group
    )
    return Measurements(robot.name, scene.readings, (observations,))
