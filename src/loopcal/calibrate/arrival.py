# SPDX-License-Identifier: Apache-2.0
"""Are the conventions of measurements those that are stated? Tested when they arrive, before anything is fitted.

With the robot as given, unknown frames fitted and its parameters free within their tolerances, whitened rows cost

    C = min_z |r + A z|^2 + |z|^2,    A = W G D diag(tolerance)

which has a chi-square distribution with as many degrees of freedom as rows where tolerances and noise are true. The
misfit sqrt(C / rows) is then 1, and at most k where all deviations are k tolerances large. A slip of unit, order, sign or
column gives tens to millions. Only then are the other ways to read the data tried (`loopcal.measure.hypotheses`), and the
data are refused only where one of them fits far better: see docs/theory/arrival.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.calibrate.combinations import listed
from loopcal.calibrate.read_as import ReadAs, quick_misfit, refined
from loopcal.calibrate.scaling import Unknowns, unknowns
from loopcal.errors import DataError
from loopcal.linalg import FloatArray
from loopcal.measure import Measurements, check_actuators, check_moved
from loopcal.measure.checks import stays
from loopcal.measure.hypotheses import Hypothesis, hypotheses, readings_hypotheses
from loopcal.mechanism import Mechanism, forward
from loopcal.units import DISPLAY_UNITS, Dimension, unit

IMPLAUSIBLE = 10.0
"""Misfit from which conventions are doubted. Tolerances exceeded three times and a noise stated three times too small
give about 3 each."""

BETTER = 5.0
"""How many times better another convention must fit before data are refused: true data of a robot far off its tolerances
are fitted by none of them twice as well."""

ALLOWED = 4.0
"""Misfit up to which tolerances and noise are said to allow a residual."""

MOST, RUNS = 120, 4
"""Poses of large data sets by which other readings are judged, and runs of neighbours (rows may be one off) they come in."""

EQUALLY = 1.2
"""Ratio of misfits up to which two conventions fit equally well; the first in the list is named, the others beside it."""


@dataclass(frozen=True, eq=False)
class Arrival:
    """The stated conventions of measurements against the robot, and the best other ones.

    Attributes
    ----------
    misfit : root mean square of what is left over what tolerances and noise allow [1]; NaN where there are too few rows.
    other : how else the data may be meant; None where nothing else was tried, or nothing fits far better.
    other_misfit : its misfit; NaN without one.
    alike : words of others that fit as well.
    sentence : what this means; empty where all is well.
    """

    misfit: float
    other: str | None = None
    other_misfit: float = float("nan")
    alike: tuple[str, ...] = ()
    sentence: str = ""

    @property
    def doubtful(self) -> bool:
        """Whether tolerances and noise do not explain the data as they are stated."""
        return self.misfit > IMPLAUSIBLE

    @property
    def refused(self) -> bool:
        """Whether there is clear evidence that something else was meant."""
        return self.other is not None

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON."""
        return {**vars(self), "alike": list(self.alike), "refused": self.refused}


def arrival(robot: Mechanism, data: Measurements) -> Arrival:
    """Compare measurements with a robot under the stated conventions and, where these are implausible, under others.

    Parameters
    ----------
    robot : as given, before any fit: its values, its tolerances (stated, or the default ones).
    data : as read.

    Returns
    -------
    Arrival

    Raises
    ------
    DataError
        Readings of another number of actuators.
    """
    check_actuators(data, robot)
    free, believed = unknowns(robot), _believed(data)
    if believed is None:
        return Arrival(float("nan"))
    uncertain = data.reading_sigma is not None and bool(np.any(np.isfinite(data.reading_sigma) & (data.reading_sigma > 0.0)))
    data = believed
    misfit = quick_misfit(free, data)
    if misfit <= IMPLAUSIBLE:
        return Arrival(misfit)
    stated = ReadAs(free, _thinned(data))
    misfit = stated.misfit()
    if not misfit > IMPLAUSIBLE:
        return Arrival(misfit)
    stated.leave_out()
    misfit = min(misfit, stated.misfit(), refined(stated))
    if not misfit > IMPLAUSIBLE:
        return Arrival(misfit)
    best, alike = _best(free, stated, misfit)
    if best is None:
        return Arrival(misfit, sentence="" if uncertain else _unexplained(stated, misfit))
    words = tuple(h.words for h in alike)
    sentence = _evidence(stated, misfit, best, words)
    assert best.hypothesis is not None
    return Arrival(misfit, best.hypothesis.words, best.found, words, sentence)


def check_arrival(
    robot: Mechanism,
    data: Measurements,
    *,
    allow_still: bool = False,
    allow_implausible: bool = False,
    overrides: tuple[str, str] = ("allow_still=True", "allow_implausible=True"),
) -> Arrival:
    """Refuse a target that no pose moves, and measurements of which there is clear evidence that they mean something else.

    `loopcal.io.load_measurements` calls this for every file; call it for measurements that come from elsewhere.

    Parameters
    ----------
    robot, data : see `arrival`.
    allow_still : accept targets that no pose moves. allow_implausible : accept any convention; `arrival` is not asked.
    overrides : how a user of the caller says so (flags or arguments); they close the messages.

    Returns
    -------
    Arrival
        Its sentence is worth a note where it is not empty: the data fit badly, but no other way to read them fits better.

    Raises
    ------
    DataError
        With the evidence.
    """
    if not allow_still and stays(data):
        found = forward(robot, data.readings)
        if found.converged.any():
            check_moved(data.take(found.converged), found.T[found.converged], override=overrides[0])
    if allow_implausible:
        return Arrival(float("nan"))
    told = arrival(robot, data)
    if told.refused:
        raise DataError(f"{told.sentence}, or use {overrides[1]}")
    return told


def _believed(data: Measurements) -> Measurements | None:
    """The poses all of whose readings were taken and are believed; None where there is none."""
    if data.reading_sigma is None:
        return data
    there = np.isfinite(data.reading_sigma).all(axis=1) & np.isfinite(data.readings).all(axis=1)
    return replace(data.take(there), reading_sigma=None) if there.any() else None


def _thinned(data: Measurements) -> Measurements:
    """At most `MOST` poses, in runs of neighbours spread over the data; all where rows share more than their pose."""
    n = data.n_poses
    shared = any(o.kind.links > 1 or bool((o.group != "").any()) for o in data.observations)
    if n <= MOST or shared:
        return data
    first = np.linspace(0, n - MOST // RUNS, RUNS).astype(np.intp)
    return data.take(np.unique(first[:, None] + np.arange(MOST // RUNS)))


def _best(free: Unknowns, stated: ReadAs, misfit: float) -> tuple[ReadAs | None, list[Hypothesis]]:
    """The way that fits far better than what is stated, if there is one, and others that fit as well."""
    ranked = [(found, way) for way, found in _tried(free, stated) if found * BETTER < misfit]
    ranked = [(found, way) for found, way in ranked if _tells(free, stated, way, found)]
    if not ranked:
        return None, []
    smallest = min(found for found, _ in ranked)
    near = [way for found, way in ranked if found <= max(EQUALLY * smallest, 1.0)]
    best = ReadAs(free, near[0].applied(stated.whole), hypothesis=near[0])
    best.misfits()
    best.leave_out()
    best.found = min(best.misfit(), refined(best))
    return (best, near[1:]) if best.found * BETTER < misfit else (None, [])


def _tried(free: Unknowns, stated: ReadAs) -> list[tuple[Hypothesis, float]]:
    """Hypotheses with their misfits, to first order, blunders left out; those that cannot be evaluated are not there.

    The readings are read otherwise only where no other way to read the measured values is allowed: each needs its own poses.
    """
    robot, found = free.robot, []
    ways = tuple(hypotheses(stated.data)) if stated.enough else ()
    if ways:
        found += _misfits(free, stated.data, ways)
    if any(value <= ALLOWED for _, value in found):
        return found
    names = tuple(a.name for a in robot.actuators)
    for way in readings_hypotheses(stated.whole, names, tuple(a.dimension for a in robot.actuators)):
        one = ReadAs(free, way.applied(stated.whole), hypothesis=way)
        one.misfits()
        one.leave_out()
        found.append((way, one.misfit()))
    return [(way, value) for way, value in found if np.isfinite(value)]


def _misfits(free: Unknowns, data: Measurements, ways: tuple[Hypothesis, ...]) -> list[tuple[Hypothesis, float]]:
    """Misfits of ways to read the values, all at once; where one cannot be evaluated, each half for itself."""
    together = ReadAs(free, data, ways)
    values = together.misfits()
    if np.isnan(values).any() and len(ways) > 1:
        middle = len(ways) // 2
        return _misfits(free, data, ways[:middle]) + _misfits(free, data, ways[middle:])
    if np.isnan(values).any():
        return []
    together.leave_out()
    return list(zip(ways, together.misfits().tolist(), strict=True))


def _tells(free: Unknowns, stated: ReadAs, way: Hypothesis, found: float) -> bool:
    """Whether values that shrink fit far better than a constant in their place would: zeros fit every unit."""
    if not way.shrinks:
        return True
    written = stated.whole.readings if way.kind is None else stated.whole.observations[way.kind].measured
    still = np.where(way.values != written, np.nanmedian(way.values, axis=0), way.values)
    control = ReadAs(free, replace(way, values=still).applied(stated.whole), hypothesis=way)
    control.misfits()
    control.leave_out()
    return not control.misfit() < BETTER * found


def _evidence(stated: ReadAs, misfit: float, best: ReadAs, alike: tuple[str, ...]) -> str:
    """The sentence that refuses."""
    way = best.hypothesis
    assert way is not None
    much = "which is what tolerances and noise allow" if best.found <= ALLOWED else f"{best.found:.2g} times what they allow"
    others = f" (or with {listed(alike, 2)})" if alike else ""
    return (
        f"the data do not fit {stated.free.robot.name!r} as they are written: {_left(stated, misfit)}; with {way.words}"
        f" {_size(best)} is left, {much}{others}; {way.cure}"
    )


def _unexplained(stated: ReadAs, misfit: float) -> str:
    """The sentence that only notes."""
    return (
        f"the data do not fit {stated.free.robot.name!r}: {_left(stated, misfit)}, and no other unit, order, sign or column"
        " explains it; check the noise, the tolerances and dimensions of the robot, and that the data are of this robot"
    )


def _left(stated: ReadAs, misfit: float) -> str:
    if not stated.enough:
        return f"the robot reaches only {stated.reached} of {stated.poses} poses that were tried with these readings"
    return f"{_size(stated)} (rms) is left, {misfit:.2g} times what tolerances and noise allow"


def _size(way: ReadAs) -> str:
    """Root mean squares of the first way's residuals by dimension, in units of the robot's file, blunders left out."""
    square: dict[Dimension, list[FloatArray]] = {}
    way.misfits()
    for s, r in zip(way.rows.sensed, way.rows.residuals(way.z[:1]), strict=True):
        there = np.einsum("rmm->rm", s.whitener[0]) != 0.0
        for j, column in enumerate(s.kind.noise_columns):
            square.setdefault(column.dimension, []).append(r.raw[0, there[:, j], j] ** 2)
    shown = []
    for dimension, parts in square.items():
        value = np.concatenate(parts)
        if len(value):
            symbol = way.free.robot.units.get(dimension, DISPLAY_UNITS[dimension].symbol)
            shown.append(f"{np.sqrt(value.mean()) / unit(symbol).factor_to_si:.3g} {symbol}")
    return listed(shown)
