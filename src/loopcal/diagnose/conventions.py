# SPDX-License-Identifier: Apache-2.0
"""Are the conventions of measurements those that are stated? Tested when they arrive, before
anything is fitted.

With the robot as given, unknown frames fitted and its parameters free within their tolerances,
whitened rows cost

    C = min_z |r + A z|^2 + |z|^2,    A = W G D diag(tolerance)

which has a chi-square distribution with as many degrees of freedom as rows where tolerances and
noise are true. The misfit sqrt(C / rows) is then 1, and at most k where all deviations are k
tolerances large. A slip of unit, order, sign or column gives tens to millions. Only then are the
other ways to read the data tried (`loopcal.diagnose.interpretations`), and the data are refused
only where one of them fits far better: see docs/theory/arrival.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.diagnose.interpretations import (
    Interpretation,
    list_interpretations,
    list_reading_interpretations,
)
from loopcal.diagnose.read_as import MOST_LEFT_OUT, InterpretedData, begun, quick_misfit, refined
from loopcal.diagnose.stated_unknowns import Contradiction, contradicted
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.inference.null_space import listed
from loopcal.measure import Measurements, check_actuators, check_targets_move
from loopcal.measure.data_checks import stays
from loopcal.mechanism import Mechanism, find_directly_reachable, forward
from loopcal.typing import FloatArray, IntArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

IMPLAUSIBLE = 10.0
"""Misfit from which conventions are doubted. Tolerances exceeded three times and a noise stated
three times too small
give about 3 each."""

BETTER = 5.0
"""How many times better another convention must fit before data are refused: true data of a robot
far off its tolerances
are fitted by none of them twice as well."""

ALLOWED = 4.0
"""Misfit up to which tolerances and noise are said to allow a residual."""

MOST, RUNS = 120, 4
"""Poses of large data sets by which other readings are judged, and runs of neighbours (rows may be
one off) they come in.
"""

FEW, SCREENED = 60, 20
"""Rows, and at least poses, by which all other readings are compared before those that promise
something are judged.
"""

PROMISING, JUDGED = 2.0, 8
"""Times that the misfit on these rows may exceed what counts as far better, and how many readings
at most are judged.
"""

NEAREST = 8
"""Ways to read the readings that are judged where frames are unknown: those that leave least before
parameters move.
"""

EQUALLY = 1.2
"""Ratio of misfits up to which two conventions fit equally well; the first in the list is named,
the others beside it.
"""


SHOWN = 12
"""Labels of rows that are named in one sentence."""

GROSS = 100.0
"""Misfit from which a contradiction between the data and what is stated of a frame is refused;
below, robots far off their
tolerances show the same, and it is noted."""


@dataclass(frozen=True, eq=False)
class ConventionCheck:
    """The stated conventions of measurements against the robot, and the best other ones.

    Attributes
    ----------
    misfit : root mean square of what is left over what tolerances and noise allow [1]; NaN where
        there are too few rows.
    other : how else the data may be meant; None where nothing else was tried, or nothing fits far
        better.
    other_misfit : its misfit, or that without stated unknowns which the data contradict; NaN
        without one.
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


def compare_conventions(
    robot: Mechanism, data: Measurements, parts: Sequence[str] = ()
) -> ConventionCheck:
    """Compare measurements with a robot under the stated conventions and, where these are
    implausible, under others.

    Parameters
    ----------
    robot : as given, before any fit: its values, its tolerances (stated, or the default ones).
    data : as read. parts : where the rows of each of its observations come from, such as files, for
        the words.

    Returns
    -------
    ConventionCheck

    Raises
    ------
    DataError
        Readings of another number of actuators.
    """
    check_actuators(data, robot)
    free, believed = select_free_parameters(robot), _believed(data)
    if believed is None:
        return ConventionCheck(float("nan"))
    uncertain = data.reading_sigma is not None and bool(
        np.any(np.isfinite(data.reading_sigma) & (data.reading_sigma > 0.0))
    )
    data = believed
    misfit = quick_misfit(free, data)
    if misfit <= IMPLAUSIBLE:
        return ConventionCheck(misfit)
    stated = InterpretedData(free, _thinned(data))
    misfit = stated.misfit()
    if not misfit > IMPLAUSIBLE:
        return ConventionCheck(misfit)
    stated.leave_out()
    misfit = min(misfit, stated.misfit(), refined(stated))
    if not misfit > IMPLAUSIBLE:
        return ConventionCheck(misfit, sentence=_set_aside(stated))
    against = contradicted(free, stated, misfit, BETTER)
    if against is not None and against.misfit <= ALLOWED:
        return _contradiction(misfit, against)
    best, alike = _best(free, stated, misfit, parts)
    if best is None and against is not None:
        return _contradiction(misfit, against)
    if best is None:
        return ConventionCheck(misfit, sentence="" if uncertain else _unexplained(stated, misfit))
    words = tuple(h.words for h in alike)
    sentence = _evidence(stated, misfit, best, words)
    assert best.hypothesis is not None
    return ConventionCheck(misfit, best.hypothesis.words, best.found, words, sentence)


def check_conventions(
    robot: Mechanism,
    data: Measurements,
    *,
    allow_still: bool = False,
    allow_implausible: bool = False,
    overrides: tuple[str, str] = ("allow_still=True", "allow_implausible=True"),
    parts: Sequence[str] = (),
) -> ConventionCheck:
    """Refuse a target that no pose moves, and measurements of which there is clear evidence that
    they mean something else.

    `loopcal.io.load_measurements` calls this for every file; call it for measurements that come
    from elsewhere.

    Parameters
    ----------
    robot, data, parts : see `arrival`.
    allow_still : accept targets that no pose moves. allow_implausible : accept any convention;
        `arrival` is not asked.
    overrides : how a user of the caller says so (flags or arguments); they close the messages.

    Returns
    -------
    ConventionCheck
        Its sentence is worth a note where it is not empty: the data fit badly, but no other way to
        read them fits better.

    Raises
    ------
    DataError
        With the evidence.
    """
    if not allow_still and stays(data):
        found = forward(robot, data.readings)
        if found.converged.any():
            check_targets_move(
                data.take(found.converged), found.T[found.converged], override=overrides[0]
            )
    if allow_implausible:
        return ConventionCheck(float("nan"))
    told = compare_conventions(robot, data, parts)
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
    """At most `MOST` poses, in runs of neighbours spread over the data; all where rows share more
    than their pose.
    """
    n = data.n_poses
    if n <= MOST or _shared(data):
        return data
    first = np.linspace(0, n - MOST // RUNS, RUNS).astype(np.intp)
    return data.take(np.unique(first[:, None] + np.arange(MOST // RUNS)))


def _few(data: Measurements) -> IntArray:
    """Poses spread over the data by which many readings are compared; all where rows share more
    than their pose.
    """
    n = data.n_poses
    equations = sum(o.whitener.shape[-1] * len(o) for o in data.observations)
    count = max(SCREENED, -(-FEW * n // max(equations, 1)))
    return (
        np.arange(n)
        if n <= count or _shared(data)
        else np.unique(np.linspace(0, n - 1, count).astype(np.intp))
    )


def _shared(data: Measurements) -> bool:
    return any(o.kind.poses_per_row > 1 or bool((o.group != "").any()) for o in data.observations)


def _best(
    free: FreeParameters, stated: InterpretedData, misfit: float, parts: Sequence[str]
) -> tuple[InterpretedData | None, list[Interpretation]]:
    """The way that fits far better than what is stated, if there is one, and others that fit as
    well.
    """
    ranked = [
        (found, way)
        for way, found in _tried(free, stated, misfit, parts)
        if found * BETTER < misfit
    ]
    ranked = [(found, way) for found, way in ranked if _tells(free, stated, way, found)]
    if not ranked:
        return None, []
    smallest = min(found for found, _ in ranked)
    near = [way for found, way in ranked if found <= max(EQUALLY * smallest, 1.0)]
    best = InterpretedData(free, near[0].applied(stated.whole), hypothesis=near[0])
    best.misfits()
    best.leave_out()
    best.found = min(best.misfit(), refined(best))
    return (best, near[1:]) if best.found * BETTER < misfit else (None, [])


def _tried(
    free: FreeParameters, stated: InterpretedData, misfit: float, parts: Sequence[str]
) -> list[tuple[Interpretation, float]]:
    """Hypotheses that promise to fit far better with their misfits, to first order, blunders left
    out.

    All are compared by few rows first. The readings are read otherwise only where no other way to
    read the measured values is allowed: each needs its own poses.
    """
    found: list[tuple[Interpretation, float]] = []
    if stated.enough:
        data = stated.data
        few = data.take(_few(data))
        chosen = _promising(
            _misfits(free, few, tuple(list_interpretations(few, parts)), quick=True), misfit
        )
        ways = {way.words: way for way in list_interpretations(data, parts)}
        found = _misfits(free, data, tuple(ways[words] for words in chosen if words in ways))
    if not any(value <= ALLOWED for _, value in found):
        found += _readings_tried(free, stated.whole, misfit, parts)
    return [(way, value) for way, value in found if np.isfinite(value)]


def _readings_tried(
    free: FreeParameters, data: Measurements, misfit: float, parts: Sequence[str]
) -> list[tuple[Interpretation, float]]:
    """Hypotheses about the readings, as `_tried` gives them."""
    robot, poses = free.robot, _few(data)
    named, dimensions = (
        tuple(a.name for a in robot.actuators),
        tuple(a.dimension for a in robot.actuators),
    )
    ways = tuple(list_reading_interpretations(data, named, dimensions, parts))
    every = np.stack([way.values[poses] for way in ways])
    solved = find_directly_reachable(
        robot, robot.values[None], every.reshape(1, -1, every.shape[-1])
    ).reshape(every.shape[:2])
    near = np.flatnonzero(solved.mean(axis=1) >= 1.0 - MOST_LEFT_OUT)
    begin, left = begun(free, data.take(poses), every[near], solved[near])
    order = np.argsort(left)[:NEAREST] if len(data.nuisance_parameters) else np.arange(len(near))

    def judged(way: Interpretation, begin: FloatArray | None = None) -> float:
        read, quick = way.applied(data), begin is not None
        one = InterpretedData(
            free, read.take(poses) if quick else read, hypothesis=way, quick=quick, begin=begin
        )
        one.misfits()
        one.leave_out()
        return one.misfit()

    found = [(ways[near[i]], judged(ways[near[i]], begin[i : i + 1])) for i in np.sort(order)]
    chosen = _promising(found, misfit)
    return [(way, judged(way)) for way, _ in found if way.words in chosen]


def _promising(found: list[tuple[Interpretation, float]], misfit: float) -> list[str]:
    """Words of the best hypotheses, in the order given, that may fit far better than what is
    stated.
    """
    bound = min(
        PROMISING * misfit / BETTER,
        *sorted(value for _, value in found if np.isfinite(value))[JUDGED - 1 : JUDGED],
        np.inf,
    )
    return [way.words for way, value in found if value <= bound]


def _misfits(
    free: FreeParameters,
    data: Measurements,
    ways: tuple[Interpretation, ...],
    *,
    quick: bool = False,
) -> list[tuple[Interpretation, float]]:
    """Misfits of ways to read the values, all at once; where one cannot be evaluated, each half for
    itself.
    """
    if not ways:
        return []
    together = InterpretedData(free, data, ways, quick=quick)
    values = together.misfits()
    if together.failed and len(ways) > 1:
        middle = len(ways) // 2
        halves = (ways[:middle], ways[middle:])
        return [one for half in halves for one in _misfits(free, data, half, quick=quick)]
    if np.isfinite(values).all():
        together.leave_out()
        values = together.misfits()
    return list(zip(ways, values.tolist(), strict=True))


def _tells(
    free: FreeParameters, stated: InterpretedData, way: Interpretation, found: float
) -> bool:
    """Whether values that shrink fit far better than a constant in their place would: zeros fit
    every unit.
    """
    if not way.shrinks:
        return True
    written = (
        stated.whole.readings if way.kind is None else stated.whole.observations[way.kind].measured
    )
    still = np.where(way.values != written, np.nanmedian(way.values, axis=0), way.values)
    control = InterpretedData(
        free, replace(way, values=still).applied(stated.whole), hypothesis=way
    )
    control.misfits()
    control.leave_out()
    return not control.misfit() < BETTER * found


def _contradiction(misfit: float, against: Contradiction) -> ConventionCheck:
    """Stated unknowns without which the data fit: refused where they contradict the data grossly,
    else noted.
    """
    sentence = (
        f"the data contradict what 'unknowns' states: they put {listed(against.shown, 3)}; as "
        f"stated, {misfit:.2g} times what"
        f" tolerances and noise allow is left, and with {against.words} {_size(against.freed)}, "
        f"{_much(against.misfit)};"
        " correct or remove the statement"
    )
    return ConventionCheck(
        misfit, against.words if misfit > GROSS else None, against.misfit, (), sentence
    )


def _evidence(
    stated: InterpretedData, misfit: float, best: InterpretedData, alike: tuple[str, ...]
) -> str:
    """The sentence that refuses."""
    way = best.hypothesis
    assert way is not None
    others = f" (or with {listed(alike, 2)})" if alike else ""
    return (
        f"the data do not fit {stated.free.robot.name!r} as they are written: "
        f"{_left(stated, misfit)}; with {way.words}"
        f" {_size(best)} is left, {_much(best.found)}{others}; {way.cure}"
    )


def _much(misfit: float) -> str:
    return (
        "which is what tolerances and noise allow"
        if misfit <= ALLOWED
        else f"{misfit:.2g} times what they allow"
    )


def _set_aside(stated: InterpretedData) -> str:
    """Which rows do not fit the others, which do fit; they stay in the data."""
    poses = tuple(dict.fromkeys(stated.left_out))
    rows = sum(len(o) for o in stated.data.observations)
    return (
        f"{len(stated.left_out)} of {rows} rows that were compared do not fit the others by far "
        f"(poses {listed(poses, SHOWN)});"
        " check their units, signs and readings: they stay in the data"
    )


def _unexplained(stated: InterpretedData, misfit: float) -> str:
    """The sentence that only notes."""
    return (
        f"the data do not fit {stated.free.robot.name!r}: {_left(stated, misfit)}, and no other "
        "unit, order, sign or column"
        " explains it; check the noise, the tolerances and dimensions of the robot, and that the "
        "data are of this robot"
    )


def _left(stated: InterpretedData, misfit: float) -> str:
    if not stated.enough:
        return f"the robot reaches only {stated.reached} of {stated.poses} poses that were tried with these readings"
    return f"{_size(stated)} (rms) is left, {misfit:.2g} times what tolerances and noise allow"


def _size(way: InterpretedData) -> str:
    """Root mean squares of the first way's residuals by dimension, in units of the robot's file,
    blunders left out.
    """
    square: dict[Dimension, list[FloatArray]] = {}
    way.misfits()
    for s, r in zip(way.problem.rows, way.residuals(), strict=True):
        there = np.einsum("rmm->rm", s.whitener[0]) != 0.0
        for j, column in enumerate(s.kind.noise_columns):
            square.setdefault(column.dimension, []).append(r.raw[0, there[:, j], j] ** 2)
    shown = []
    for dimension, parts in square.items():
        value = np.concatenate(parts)
        if len(value):
            symbol = way.free.robot.units.get(dimension, DISPLAY_UNITS[dimension].symbol)
            shown.append(f"{np.sqrt(value.mean()) / find_unit(symbol).factor_to_si:.3g} {symbol}")
    return listed(shown)
