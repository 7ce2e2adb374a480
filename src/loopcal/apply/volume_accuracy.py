# SPDX-License-Identifier: Apache-2.0
"""The largest position error of a calibrated machine in a working volume.

Errors of all points of the volume are drawn together from the posterior, because parameters, frames
and slow errors are common to them. With the error e_p at the point p

    pointwise      max over p of the 95 % quantile of |e_p|
    simultaneous   95 % quantile of max over p of |e_p|

Derivation and coverage: docs/theory/accuracy.md.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from loopcal.apply.accuracy import BLOCK, PoseUncertainty, pose_uncertainty
from loopcal.apply.conformity import Conformity, judge_draws, report_decision
from loopcal.checks import check_choice
from loopcal.diagnose import error_frames
from loopcal.errors import DataError, EstimationError, UnitError
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.residual_test import LEVEL
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.findings.catalog import word_phrase
from loopcal.findings.wording import FINE
from loopcal.measure.array_checks import check_array
from loopcal.measure.instrument import make_random_stream
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION, get_dimension, read_coordinates
from loopcal.mechanism.solutions import Solution, forward, inverse
from loopcal.mechanism.workspace import find_reachable
from loopcal.results.description import Field, fields
from loopcal.results.presenters import draw
from loopcal.results.result import Result
from loopcal.results.tables import choose_unit, to_quantity
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension, parse_quantity

LENGTH = Dimension.LENGTH
CONDITIONS = "accuracy.volume-conditions"  # code of what reports add to the bound
DRAWS = 4000  # of the posterior
REFINED = 0.01  # share by which a fine grid still changes the largest error
MOST_POINTS = 4096  # of a grid
RADIUS, POINTS = "radius", "points"  # parts of a volume that are no coordinates
EXAMPLE = "x=-40mm..40mm, radius=40mm, theta=0deg,5deg, or the name of a file of points"


@dataclass(frozen=True, eq=False)
class Volume:
    """Poses over which the position error is bounded: a box, a cylinder, or a list.

    Coordinates are those that the robot is commanded in. What nothing states stays at home.

    Parameters
    ----------
    ranges : lowest and highest value of coordinates [m, rad].
    values : single values of coordinates, each combined with all others [m, rad].
    radius : of a cylinder [m], a circle of those two of x, y, z that have no range, x and y first;
        `values` state its center.
    points : (n, c) all coordinates of single poses, in place of all others.

    Raises
    ------
    DataError : nothing is stated, a range is empty, or statements contradict each other.
    """

    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    values: Mapping[str, Sequence[float]] = field(default_factory=dict)
    radius: float | None = None
    points: ArrayLike | None = None

    def __post_init__(self) -> None:
        if (self.points is None) != bool(self.ranges or self.values or self.radius is not None):
            state = "nothing" if self.points is None else "points with other parts"
            raise DataError(f"the volume contains {state}. Give {EXAMPLE}")
        for name, (low, high) in self.ranges.items():
            if name in self.values or not -math.inf < low < high < math.inf:
                raise DataError(f"give {name} of the volume one range, the lower end first")
        for name, values in self.values.items():
            if not len(check_array(values, f"the values of {name} in the volume", (None,))):
                raise DataError(f"the volume has no value of {name}. Give one, or leave it out")
        if self.radius is not None and not 0.0 < self.radius < math.inf:
            raise DataError(f"the radius of the volume is {self.radius:g} m. Give one above 0")

    def find_circle(self, robot: Mechanism) -> tuple[str, ...]:
        """Return the two coordinates of the circle of a cylinder; none of other volumes."""
        if self.radius is None:
            return ()
        free = [n for n in POSITION if n in robot.controlled and n not in self.ranges][:2]
        if len(free) < 2 or any(len(self.values.get(name, [0.0])) != 1 for name in free):
            raise DataError(
                f"a radius needs two controlled coordinates of {robot.name} among x, y, z, without "
                "a range and with one value as center. Leave out a range, or the radius"
            )
        return tuple(free)

    def list_values(self, robot: Mechanism) -> dict[str, Sequence[float]]:
        """Return the values of all coordinates; those of home where none is stated."""
        for name in (*self.ranges, *self.values):
            check_choice("a coordinate of the volume", name, robot.controlled, DataError)
        home = read_coordinates(robot.home[None], robot.controlled)[0] + 0.0
        pairs = zip(robot.controlled, home.tolist(), strict=True)
        return {name: self.values.get(name, [x]) for name, x in pairs}

    def list_spans(self, robot: Mechanism) -> dict[str, tuple[float, float]]:
        """Return the ends of the grid by coordinate [m, rad]; of a circle about its center."""
        radius = self.radius or 0.0
        return {**self.ranges, **dict.fromkeys(self.find_circle(robot), (-radius, radius))}

    def list_points(self, robot: Mechanism, count: int) -> FloatArray:
        """Return the poses (n, c) of a grid of `count` values of each range [m, rad].

        A disc is a square grid of which each square ring becomes a circle.
        """
        names, spans, values = robot.controlled, self.list_spans(robot), self.list_values(robot)
        if self.points is not None:
            what = f"the points of the volume ({', '.join(names)})"
            return check_array(self.points, what, (None, len(names)))
        axes = [np.linspace(*spans[n], count) if n in spans else values[n] for n in names]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        if self.radius is not None:
            circle = self.find_circle(robot)
            places = [names.index(name) for name in circle]
            square = points[:, places]
            length = np.maximum(np.linalg.norm(square, axis=1), np.finfo(float).tiny)
            share = np.abs(square).max(axis=1) / length
            points[:, places] = share[:, None] * square + [values[name][0] for name in circle]
        return points

    def list_grids(self, robot: Mechanism) -> Iterator[Grid]:
        """Yield the grids of which the robot reaches a point, the coarsest first.

        EstimationError : it reaches none. DataError : the volume does not suit the robot.
        """
        spans, reason = self.list_spans(robot), ""
        fixed = math.prod(len(values) for values in self.list_values(robot).values())
        fine = (1 + 2**k for k in range(12 if spans else 1))
        counts = [count for count in fine if fixed * count ** len(spans) <= MOST_POINTS]
        if not counts:
            raise DataError(f"the volume has more than {MOST_POINTS:,} points. Give fewer values")
        for count in counts[1:] if len(counts) > 2 else counts:
            points, reasons = self.list_points(robot, count), Counter[str]()
            reached, _ = find_reachable(robot, points, reasons)
            reason = reasons.most_common(1)[0][0]
            if reached.any():
                spacing = {n: (high - low) / (count - 1) for n, (low, high) in spans.items()}
                yield Grid(points[reached], reached, reason, spacing)
                reason = ""
        if reason:
            raise EstimationError(
                f"{robot.name} reaches no point of this volume ({reason}). Give another volume"
            )

    def describe(self, robot: Mechanism) -> dict[str, Any]:
        """Return the data of a sentence on the volume."""
        circle, values = self.find_circle(robot), self.list_values(robot)
        stated = (*circle, *self.ranges, *self.values)
        listed = 0 if self.points is None else len(np.asarray(self.points))
        return {
            "listed": listed,
            "radius": None if self.radius is None else robot.to_quantity(self.radius, LENGTH),
            "center": _show(robot, {name: values[name] for name in circle}),
            "ranges": _show(robot, self.ranges),
            "kept": _show(robot, {n: x for n, x in self.values.items() if n not in circle}),
            "at_home": [n for n in robot.controlled if not listed and n not in stated],
        }


class Grid(NamedTuple):
    """The points of a volume that a robot reaches."""

    points: FloatArray  # (n, c) controlled coordinates [m, rad]
    reached: BoolArray  # (m,) of all points
    reason: str  # why the robot does not reach most of the others
    spacing: Mapping[str, float]  # of neighbors, by coordinate [m, rad]


def _show(robot: Mechanism, values: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """Return values of coordinates in the units in which they are shown."""
    return [
        {"name": name, "at": [robot.to_quantity(float(x), get_dimension(name)) for x in of]}
        for name, of in values.items()
    ]


VolumeLike = Volume | Mapping[str, tuple[float, float]] | ArrayLike


def as_volume(volume: VolumeLike) -> Volume:
    """Return a volume as it is, a mapping as ranges, and an array as points."""
    if isinstance(volume, Volume):
        return volume
    return Volume(volume) if isinstance(volume, Mapping) else Volume(points=volume)


def parse_volume_part(text: str) -> tuple[str, Any]:
    """Return the name and value of a part of a volume: of x=-40mm..40mm a range (tuple), of
    radius=40mm a number, of theta=0deg,5deg a list of values.

    UnitError : another text, a wrong unit, or a range that ends below its beginning.
    """
    name, _, stated = text.partition("=")
    if not (name and stated):
        raise UnitError(f"{text!r} is neither a file nor a part of a volume. Give {EXAMPLE}")
    if name == RADIUS:
        return name, parse_quantity(stated, LENGTH)
    is_range = ".." in stated
    ends = stated.split(".." if is_range else ",")
    numbers = [parse_quantity(number, get_dimension(name)) for number in ends]
    if is_range and not (len(numbers) == 2 and numbers[0] < numbers[1]):
        raise UnitError(f"{text!r} is not a range. Give the smaller end first, as x=-40mm..40mm")
    return name, tuple(numbers) if is_range else numbers


def join_volume(parts: Iterable[tuple[str, Any]]) -> Volume:
    """Return the volume of which each part states something, see `parse_volume_part`.

    DataError : two parts state the same.
    """
    stated: dict[str, Any] = {}
    for name, value in parts:
        if name in stated:
            raise DataError(f"the volume contains {name} twice. Keep one of the two")
        stated[name] = value
    others = {name: stated.pop(name, None) for name in (RADIUS, POINTS)}
    ranges = {name: value for name, value in stated.items() if isinstance(value, tuple)}
    return Volume(ranges, {n: x for n, x in stated.items() if n not in ranges}, **others)


@dataclass(frozen=True, eq=False, repr=False)
class VolumeAccuracy(Result):
    """The largest position error in a volume, with a coverage probability of 95 %.

    Attributes
    ----------
    volume : the stated one.
    simultaneous : the errors at all points of the volume are at most this, together [m].
    pointwise : the error at each single point is at most this; others may exceed it [m].
    worst : coordinates of the point with the largest pointwise bound [m, rad].
    points : number of compared points, which are those that the robot reaches. reachable : their
        share of the volume.
    spacing : of neighbors, by coordinate [m, rad]; empty for a list of points.
    refinement : share by which the last refinement changed `simultaneous`; NaN for a list.
    extrapolated : share of the points that are less certain than every measured pose.
    reference : point and frame to which the errors refer.
    conformity : of the largest error with a limit, if one is stated.
    findings : the statement in words, what restricts it, and the decision on the limit.
    robot : the machine. bounds : (m,) of the error at grid points [m], NaN out of reach.
    """

    volume: Volume
    simultaneous: float
    pointwise: float
    worst: Mapping[str, float]
    points: int
    reachable: float
    spacing: Mapping[str, float]
    refinement: float
    extrapolated: float
    reference: Finding
    conformity: Conformity | None
    findings: tuple[Finding, ...]
    robot: Mechanism
    bounds: FloatArray

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("simultaneous", "pointwise", "worst", "points", "reachable", "spacing"),
        *fields("refinement", "extrapolated", "volume", "findings"),
        *fields(frame=lambda stated: str(stated.reference), confidence=lambda _: LEVEL),
        *fields(words=lambda stated: word_phrase("volume", stated.findings[0].data)),
        Field("conformity", is_optional=True),
    )

    plot = draw  # in the colors of the error at each point


def bound_errors(
    fit: Identification | Posterior,
    volume: VolumeLike,
    frame: str = error_frames.FITTED,
    seed: int = 0,
    limit: float | None = None,
) -> VolumeAccuracy:
    """State the largest position error of the tool in a volume, at all of its points together.

    The errors of all points are drawn together from the posterior. The statement is the 95 %
    quantile of the largest error of each draw. The scatter of the readings counts for one approach
    to any point of a box or cylinder, and for one to each point of a list. Points that the robot
    does not reach are left out, and the statement says so.

    Parameters
    ----------
    volume : a `Volume`; or ranges of controlled coordinates as in `workspace:` of a robot file
        [m, rad]; or points (n, c). A grid is refined until the statement changes by less than 1 %.
    frame : see `pose_uncertainty`. seed : of the draws. limit : of the error, for conformity [m].

    Raises
    ------
    EstimationError : the robot reaches no point of the volume, or the data do not determine its
        errors there. DataError : the volume does not suit the robot.
    """
    posterior, volume = fit.posterior if isinstance(fit, Identification) else fit, as_volume(volume)
    robot, home = posterior.robot, error_frames.solve_home(posterior.robot)
    chosen = error_frames.choose_error_frame(posterior, frame, home, "home")
    compute = partial(pose_uncertainty, posterior, frame=frame, origin=home, origin_name="home")
    grids, refinement = volume.list_grids(robot), math.nan
    grid, is_list = next(grids), volume.points is not None
    draw = partial(_draw_errors, posterior, compute, chosen, is_list, seed)
    drawn = draw(inverse(robot, grid.points))
    for grid in grids:
        last = drawn.simultaneous
        drawn = draw(inverse(robot, grid.points))
        refinement = abs(drawn.simultaneous - last) / max(last, np.finfo(float).tiny)
        if refinement < REFINED:
            break
    outside = 0.0
    if posterior.frames is not None and len(posterior.frames.readings):
        measured = compute(forward(robot, posterior.frames.readings))
        outside = float((drawn.rms > np.nanmax(measured.position)).mean())
    simultaneous, pointwise, n = drawn.simultaneous, float(drawn.pointwise.max()), len(grid.points)
    place = grid.points[int(drawn.pointwise.argmax())] + 0.0
    worst = dict(zip(robot.controlled, place.tolist(), strict=True))
    words, reference = volume.describe(robot), chosen.describe(axes="")
    unit = choose_unit(robot.get_unit(LENGTH), [pointwise], FINE)
    words |= {
        "simultaneous": to_quantity(simultaneous, unit),
        "pointwise": to_quantity(pointwise, unit),
        "worst": _show(robot, {x: [at] for x, at in worst.items() if x not in words["at_home"]}),
        "refinement": None if math.isnan(refinement) else refinement,
        "repeatability_stated": bool(posterior.repeatability.any()),
        **reference.data,
    }
    findings = [report_finding(of, points=n, **words) for of in ("accuracy.volume", CONDITIONS)]
    reachable, bounds = float(grid.reached.mean()), np.full(len(grid.reached), math.nan)
    bounds[grid.reached] = drawn.pointwise
    if reachable < 1.0:
        reach = {"reachable": reachable, "reason": grid.reason}
        findings.append(report_finding("accuracy.volume-reach", points=n, **reach))
    if outside:
        findings.append(report_finding("accuracy.volume-extrapolated", share=outside))
    judged = None if limit is None else judge_draws(drawn.largest, limit)
    if judged is not None:
        findings.append(report_decision("position", judged, robot.get_unit(LENGTH)))
    return VolumeAccuracy(
        *(volume, simultaneous, pointwise, worst, n, reachable, grid.spacing, refinement),
        *(outside, reference, judged, tuple(findings), robot, bounds),
    )


class _DrawnErrors(NamedTuple):
    """Errors of n points, drawn from a posterior [m]."""

    largest: FloatArray  # (DRAWS,) of all points
    pointwise: FloatArray  # (n,) quantile of the error of each point
    rms: FloatArray  # (n,) root mean square of the error of each point

    @property
    def simultaneous(self) -> float:
        """Quantile of the largest error."""
        return float(np.quantile(self.largest, LEVEL))


def _draw_errors(
    posterior: Posterior,
    compute: Callable[[Solution], PoseUncertainty],
    frame: error_frames.ErrorFrame,
    is_list: bool,
    seed: int,
    solution: Solution,
) -> _DrawnErrors:
    """Return errors of reached poses; EstimationError where the data do not determine them.

    is_list : whether the scatter of the readings is that of an approach to each pose; otherwise it
        is that of one approach to any.
    """
    single = compute(solution)
    if not np.isfinite(single.position).all():
        raise EstimationError(
            "the measurements do not determine the position error in this volume. Measure more "
            "poses, or use another frame"
        )
    root = posterior.without_discrepancy.root / posterior.unit[:, None]
    # effects of each pose alone: those of a discrepancy, and of an approach to each
    own = 6 * (posterior.discrepancy is not None) + is_list * len(posterior.repeatability)
    random, largest, pointwise = make_random_stream(seed, 0), np.zeros(DRAWS), []
    left = float(single.degrees.position.min())
    size = np.sqrt(left / random.chisquare(left, DRAWS)) if np.isfinite(left) else 1.0
    common: FloatArray | None = None
    for first in range(0, len(solution.q), BLOCK // 4):
        part = solution.take(np.arange(first, min(first + BLOCK // 4, len(solution.q))))
        errors = error_frames.linearize_tool_errors(posterior, part, frame)
        others = (errors.by_readings, errors.by_discrepancy)
        others = others[::-1] if is_list else others
        effects = np.concatenate([errors.by_parameters @ root, errors.by_frame, *others], axis=2)
        shared, alone = np.split(effects[:, 3:], [effects.shape[2] - own], axis=2)
        if common is None:
            common = random.standard_normal((shared.shape[2], DRAWS))
        drawn = shared @ common
        if alone.any():
            axes, sd, _ = np.linalg.svd(alone, full_matrices=False)
            drawn += (axes * sd[:, None]) @ random.standard_normal((*sd.shape, DRAWS))
        length = size * np.sqrt(np.einsum("nid,nid->nd", drawn, drawn))
        largest = np.maximum(largest, length.max(axis=0))
        pointwise.append(np.quantile(length, LEVEL, axis=1))
    return _DrawnErrors(largest, np.concatenate(pointwise), single.position)
