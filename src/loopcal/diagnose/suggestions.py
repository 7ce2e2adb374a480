# SPDX-License-Identifier: Apache-2.0
"""What further measurement would determine a combination that stays open: by trying every known
kind.

With a basis B (d, p) of the open combinations, in tolerances, and the triangular factor X of a
further instrument's rows (its own unknowns eliminated), what stays open is the null space of X B'.
A combination is determined when no direction of it has a part left in that combination.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.identifiability_analysis import Identifiability, identifiability
from loopcal.diagnose.meaning import probed
from loopcal.errors import DataError, MechanismError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import Combination, listed, sparsify_basis
from loopcal.estimate.information import ObservedPoses, instrument_factor, observe_poses
from loopcal.measure import (
    KINDS,
    Component,
    Gaussian,
    JointSensor,
    Kind,
    Measurements,
    Observations,
    Sensor,
)
from loopcal.mechanism import Mechanism, sample_workspace
from loopcal.typing import FloatArray
from loopcal.units import Dimension

POSES = 24
"""Poses at which a further instrument is supposed to look."""

SEEN = 1e-8
"""Singular value, relative to the largest of the instrument's rows and of those there are, above
which it shows a direction.
"""

HELP = 0.9
"""A cure must bring the leading parameter below this share of what is left of its tolerance now."""

NAMED = 4
"""Further measurements written out in a sentence; the others are counted."""

FEW = 3
"""Open combinations at most that are written out in a refusal."""

TILT = "tilt-torsion"
SINGLE = (("x",), ("y",), ("z",), ("psi",), ("theta",), ("phi", "theta"))
"""Coordinates to measure one by one, the simplest remedies."""

ASSUMED_FRAMES = "frames of further measurements are known in the base (a datum on it), unless they are said to be unknown"
"""What a remedy takes for granted."""

SIGMA = {Dimension.LENGTH: 1e-5, Dimension.ANGLE: 5e-5, Dimension.RATIO: 5e-5}
"""Standard deviations [SI] of a further instrument where none are stated."""


@dataclass(frozen=True)
class FurtherMeasurement:
    """A further measurement that determines a combination.

    Attributes
    ----------
    words : what to measure. kind : its kind. left : standard deviation of the combination's first
        parameter over its tolerance, from the data, the further measurement and the tolerances
        together.
    """

    words: str
    kind: str
    left: float


@dataclass(frozen=True, eq=False)
class MeasurementSuggestion:
    """A combination that stays open, and what would determine it: simplest first."""

    combination: Combination
    cures: tuple[FurtherMeasurement, ...]

    def __str__(self) -> str:
        names, one = listed(self.combination.names), len(self.combination.names) == 1
        if not self.cures:
            return f"{names}: none of the known kinds of measurement would tell; fix {'it' if one else 'one of them'}"
        first, others = self.cures[0], [cure.words for cure in self.cures[1:]]
        them = "it" if one else "them"
        words = (
            f"{names}: measuring {first.words} as well would determine {them} "
            f"({self.combination.names[0]} to "
            f"{first.left:.2g} of its tolerance, from {POSES} poses)"
        )
        return f"{words}; so would {listed(others, NAMED)}" if others else words

    def to_dict(self) -> dict[str, object]:
        """Names, all cures, and the sentence."""
        cures = [vars(cure) for cure in self.cures]
        return {"names": list(self.combination.names), "cures": cures, "sentence": str(self)}


def suggest_measurements(
    found: Identifiability, sigma: dict[Dimension, float] | None = None
) -> tuple[MeasurementSuggestion, ...]:
    """Try every known kind at poses of the workspace, one after the other, on the combinations that
    stay open.

    Parameters
    ----------
    found : what `identifiability` returned. sigma : standard deviations of the further instrument
        by dimension [SI].

    Returns
    -------
    One remedy for each of `found.unidentifiable`, in order.
    """
    if not found.unidentifiable:
        return ()
    free = found.unknowns
    B = sparsify_basis(found.null_space())
    B = B / np.linalg.norm(B, axis=1, keepdims=True)
    leading = [free.names.index(c.names[0]) for c in found.unidentifiable]
    cures: list[list[FurtherMeasurement]] = [[] for _ in leading]
    # what a kind sees must stand out from the rounding of what is measured already, not only from
    # its own
    floor, present = float(np.linalg.norm(found.factor, ord=2)), _left(found.factor)
    passive = _passive(free.robot)
    at = _scene(free, [name for name, _ in passive])
    for words, kind in _candidates(free.robot, passive):
        try:
            X = instrument_factor(at, _seen(at, kind, SIGMA | (sigma or {})))[0, :-1, :-1]
        except DataError:
            continue  # this kind has nothing to look at on this robot
        determined = _determined(X, B, floor)
        if determined.any():
            left = _left(np.concatenate([found.factor, X]))
            for i in np.flatnonzero(determined & (left[leading] < HELP * present[leading])):
                cures[i].append(FurtherMeasurement(words, kind.name, float(left[leading[i]])))
    pairs = zip(found.unidentifiable, cures, strict=True)
    return tuple(MeasurementSuggestion(combination, tuple(some)) for combination, some in pairs)


def describe_missing_equations(robot: Mechanism, data: Measurements) -> str:
    """What too few equations leave open and what would determine it, for a refusal; empty where
    that is too much to say.

    Parameters
    ----------
    robot, data : as for `identifiability`.
    """
    if int(robot.parameters.free.sum()) - data.n_rows > FEW:
        return ""
    found = suggest_measurements(identifiability(robot, data))
    if not 0 < len(found) <= FEW:
        return ""
    common = [
        cure.words
        for cure in found[0].cures
        if all(cure.words in {c.words for c in other.cures} for other in found)
    ]
    advice = f"add {common[0]}" if common else "no one kind of measurement would tell all of it"
    return f" ({'; '.join(str(remedy.combination) for remedy in found)}; {advice})"


def _scene(free: FreeParameters, joints: list[str]) -> ObservedPoses:
    """Poses drawn from the workspace, or about home where none is stated."""
    try:
        q = sample_workspace(free.robot, POSES, seed=0).solution.q
    except MechanismError:
        return probed(free, joints)
    return observe_poses(free, q, joints)


def _passive(robot: Mechanism) -> list[tuple[str, str]]:
    """Passive joints a sensor could be put on, with what it would measure."""
    return [
        (f"{limb.name}.{joint.name}", "length" if joint.kind == "P" else "angle")
        for limb in robot.assembly.limbs
        for joint in limb.joints
        if joint.actuator is None
    ]


def _candidates(robot: Mechanism, passive: list[tuple[str, str]]) -> Iterator[tuple[str, Kind]]:
    """What could be measured, in words, the simplest first: what needs no frame, single
    coordinates, other kinds, joints.
    """
    # examples of Component and JointSensor are of one robot; both are made for this one
    known = [kind for kind in KINDS.values() if not issubclass(kind, (Component, JointSensor))]
    yield from _examples([kind for kind in known if kind.poses_per_row > 1])
    for names in SINGLE:
        yield " and ".join(names), Component(names, None if names[0] in "xyz" else TILT)
    yield from _examples([kind for kind in known if kind.poses_per_row == 1])
    for name, measures in passive:
        yield f"the joint {name}", JointSensor(joints=(name,), measures=measures)


def _examples(kinds: Iterable[type[Kind]]) -> Iterator[tuple[str, Kind]]:
    """Examples of kinds that differ in words."""
    said: set[str] = set()
    for kind in (example for one in kinds for example in one.examples()):
        words = _words(kind)
        if words not in said:
            said.add(words)
            yield words, kind


def _words(kind: Kind) -> str:
    """A kind with what is unknown of it."""
    targets, unknown = getattr(kind, "targets", ()), list(kind.setup_items)
    if kind.description and not unknown:
        return kind.description
    words = f"the {kind.name}" + (f" of {len(targets)} targets" if len(targets) > 1 else "")
    return f"{words} ({listed(unknown)} unknown)" if unknown else words


def _seen(at: ObservedPoses, kind: Kind, sigma: dict[Dimension, float]) -> Measurements:
    """What an instrument of this kind reads at the scene, without noise."""
    robot = at.free.robot
    noise = Gaussian(np.array([sigma[column.dimension] for column in kind.noise_columns]))
    sensor = Sensor(kind.with_tool(robot.tool), noise).assign_rows(len(at.readings))
    rows, mounted = sensor.rows, sensor.kind
    assert rows is not None
    joints = (
        np.stack([at.joints[name][:, rows] for name in kind.sensed_joints], axis=-1)
        if kind.sensed_joints
        else None
    )
    zero = np.zeros((1, len(rows), len(kind.noise_columns)))
    measured = mounted.measure(at.T[:, rows], zero, None, joints)[0]
    seen = Observations.from_sigma(
        mounted, rows, measured, noise.sigma, sensor.session, sensor.group
    )
    return Measurements(robot.name, at.readings, (seen,))


def _determined(X: FloatArray, B: FloatArray, floor: float) -> np.ndarray:
    """Which combinations (d,) the rows X (p, p) tell from all others; `floor` is the size of the
    rows there are already.
    """
    _, s, vt = np.linalg.svd(X @ B.T)
    largest = max(float(np.linalg.norm(X, ord=2)), floor)
    still_open = vt[s <= SEEN * largest] if largest > 0.0 else vt
    return np.asarray(np.linalg.norm(still_open, axis=0) <= np.sqrt(SEEN))


def _left(rows: FloatArray) -> FloatArray:
    """Standard deviations (p,) over tolerances, tolerances as a prior."""
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    return np.sqrt((vt**2 / (1.0 + s[:, None] ** 2)).sum(axis=0))
