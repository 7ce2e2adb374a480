# SPDX-License-Identifier: Apache-2.0
"""A scene: a robot at home with its measured poses, its errors there, and its accuracy map.

One scene is drawn twice: as a picture by `draw_scene`, in space and from above (a machine in an
upright plane is shown from the side), and by the script of the 3-D view (tools/viewer), which reads
it as JSON. A limb has the same color in both views of a picture. A short line through a point is
the axis of a revolute joint, a dashed line is the guide of a sliding joint, and a filled point is
driven.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from loopcal.apply.accuracy import AccuracyMap
from loopcal.engine import State
from loopcal.findings.wording import name_count
from loopcal.mechanism.assembly import BASE, PLATFORM
from loopcal.mechanism.kinematics import compute_limb_frames, compute_readings, locate_anchors
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, forward
from loopcal.numerics.statistics import choose_evenly
from loopcal.plain_text import escape
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    ERROR,
    FRAME_COLORS,
    LABEL,
    POSE,
    SEQUENTIAL,
    SMALL,
    THIN,
    add_colorbar,
    add_legend,
    finish_figure,
    label_axes,
    start_figure,
)
from loopcal.results.presenters import register
from loopcal.results.tables import choose_unit, format_number
from loopcal.typing import FloatArray, IntArray
from loopcal.units import DISPLAY_UNITS, Dimension, Unit, find_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONGEST = 0.15  # length of the longest drawn error or motion, as a share of the robot's size
STEP = 1e-4  # largest change of a value in a difference quotient, in robot sizes or as an angle
SMALLEST = 1e-9  # error or motion that is not drawn larger, as a share of the robot's size


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Measured poses that the geometries before and after calibration both reach.

    labels : of the n poses. solution : of the calibrated robot.
    tool : (n, 3) tool points [m]. error : (n, 3) those of the geometry before minus these [m].
    magnification : by which factor the errors are drawn longer than the poses' scale.
    """

    labels: tuple[str, ...]
    solution: Solution
    tool: FloatArray
    error: FloatArray
    magnification: float


@dataclass(frozen=True, eq=False)
class Motion:
    """How a change of parameters moves a robot at home, while its readings stay.

    name : short, for a list. text : a sentence.
    shift : (P, 3) of the points of all parts [m]. magnification : by which it is drawn.
    """

    name: str
    text: str
    shift: FloatArray
    magnification: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot at home.

    poses : with their errors; None without a calibration.
    accuracy : uncertainty over the workspace; None where it is not known.
    motions : by the errors before calibration, and by combinations that are not determined.
    """

    robot: Mechanism
    poses: PoseErrors | None = None
    accuracy: AccuracyMap | None = None
    motions: tuple[Motion, ...] = ()

    @property
    def map_points(self) -> FloatArray:
        """(n, 3) tool points of the accuracy map [m]; NaN where a pose is unreachable."""
        if self.accuracy is None:
            return np.zeros((0, 3))
        return (self.accuracy.uncertainty.T @ self.robot.tool)[:, :3, 3]

    @property
    def map_values(self) -> tuple[FloatArray, Unit]:
        """(n,) rms position uncertainty at these points, in a unit that suits its size."""
        values = np.zeros(0) if self.accuracy is None else self.accuracy.uncertainty.position
        unit = choose_unit(DISPLAY_UNITS[Dimension.LENGTH], values)
        return values / unit.factor_to_si, unit


def compute_pose_errors(
    robot: Mechanism, initial: Mechanism, readings: FloatArray, labels: tuple[str, ...]
) -> PoseErrors:
    """Return the tool point at readings (n, a) [m or rad] of poses with labels, and the errors of
    the initial geometry there; without poses that one of the two geometries does not reach.

    robot : calibrated. initial : before calibration.
    """
    after, before = (forward(machine, readings) for machine in (robot, initial))
    reached = np.flatnonzero(after.converged & before.converged)
    tool = (after.T[reached] @ robot.tool)[:, :3, 3]
    error = (before.T[reached] @ initial.tool)[:, :3, 3] - tool
    longest = float(np.sqrt((error**2).sum(axis=1)).max(initial=0.0))
    room = min(LONGEST * robot.size, 2.0 * _find_spacing(tool, robot.size))
    magnification = _choose_magnification(longest, room, robot.size)
    named = tuple(labels[i] for i in reached)
    return PoseErrors(named, after.take(reached), tool, error, magnification)


def _find_spacing(points: FloatArray, size: float) -> float:
    """Return the median distance from points (n, 3) to the nearest one at another place [m];
    infinite without two places. Errors of near poses are alike, so that lines of twice this length
    run side by side.
    """
    from scipy.spatial import KDTree

    places = np.unique(np.round(points / (1e-3 * size)), axis=0) * 1e-3 * size
    if len(places) < 2:
        return math.inf
    return float(np.median(KDTree(places).query(places, k=2)[0][:, 1]))


def compute_motion(robot: Mechanism, change: FloatArray, name: str, text: str) -> Motion | None:
    """Return how a change (p,) of all values [SI] moves a robot; None where it does not move, or
    where the readings of home lead to no pose.

    shift = (points(values + h change / 2) - points(values - h change / 2)) / h, with a small h
    """
    if not np.any(change):
        return None
    h = STEP * robot.size / float(np.abs(change).max())
    home = compute_readings(robot, robot.values[None], robot.home_state)[0]
    ends = []
    for side in (0.5 * h, -0.5 * h):
        machine = robot.with_values(robot.values + side * change)
        solution = forward(machine, home)
        if not solution.converged.all():
            return None
        ends.append(_join(list_parts(machine, solution.state))[0])
    shift = (ends[0] - ends[1]) / h
    longest = float(np.sqrt((shift**2).sum(axis=1)).max())
    if longest <= SMALLEST * robot.size:
        return None
    return Motion(
        name, text, shift, _choose_magnification(longest, LONGEST * robot.size, robot.size)
    )


def _choose_magnification(longest: float, room: float, size: float) -> float:
    """Return by which factor lengths [m] are drawn, of which the longest gets this room: 1, 2 or 5
    times a power of ten.
    """
    if longest <= SMALLEST * size:
        return 1.0
    power = 10.0 ** math.floor(math.log10(room / longest))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= room / longest)


# The parts of a robot as points and lines in the base frame: limbs, joints, rods, platform, tool.

AXIS, GUIDE = 0.06, 0.12
"""Half the length of the axis of a revolute joint, and the length of a guide beyond its slide, both
as a share of the robot's size.
"""

SPHERE, COINCIDENT = (0.3, 0.2), 1e-9
"""Distances of the first and the last joint from the point in which all axes of a spherical limb
meet, and up to which distance points are one, all as shares of the robot's size.
"""

Role = Literal[
    "limb", "axis", "guide", "joint", "slide", "rod", "cable", "rod drive", "end",
    "base", "platform", "arm", "frame", "tool",
]  # fmt: skip
"""What a part is: the line along a limb; the axis and the place of a joint; the guide and the place
of a slide; a rod, or the cable of a spool, and where it is driven; an end of a limb; the outlines
of base and platform; the line from the platform to the tool, or from the anchors of a triangle
drive to its joint; an axis of a frame; the tool point.
"""

# Roles of lines; all others are single points.
LINES = ("limb", "axis", "guide", "rod", "cable", "base", "platform", "arm", "frame")
PLANAR = {"x", "y", "rz"}  # freedoms of a platform that moves in the x-y plane


@dataclass(frozen=True, eq=False)
class Part:
    """A line through m points, or one point, at n poses.

    role : one of `Role`. points : (n, m, 3) [m], in the base frame.
    index : number of its limb, or of the axis of a frame; -1 where it belongs to neither.
    is_driven : whether it is a joint, slide or rod with an actuator.
    """

    role: Role
    points: FloatArray
    index: int = -1
    is_driven: bool = False


def is_planar(robot: Mechanism) -> bool:
    """Return whether the platform moves in the x-y plane only: one view shows everything."""
    return set(robot.freedoms) <= PLANAR


def list_parts(robot: Mechanism, state: State) -> tuple[Part, ...]:
    """Return the parts of a robot at n poses: first the line of each limb, in their order.

    state : (1, n), of `robot.home_state` or of a solution.
    """
    T = state.T[0]
    limbs = compute_limb_frames(robot, robot.values[None], state)
    frames, traces = zip(*(_arrange_limb(limb[0], robot.size) for limb in limbs), strict=True)
    foot, top = (np.stack([limb[:, j, :3, 3] for limb in frames], axis=1) for j in (0, -1))
    lines = (Part("limb", trace, i) for i, trace in enumerate(traces))
    joints = (part for i, limb in enumerate(frames) for part in _list_joints(robot, i, limb))
    triangles, bodies = _list_triangles(robot, state), _list_bodies(robot, foot, top, T)
    return (*lines, *joints, *triangles, *bodies)


def _arrange_limb(frames: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Return the frames (n, J + 2, 4, 4) of a limb as they are drawn, and the line (n, m, 3) along
    it.

    Where three or more axes of a limb meet in one point, its links have no lengths. They are drawn
    as arcs about this point, each joint on its axis, from the motor inwards.
    """
    points, n_joints = frames[:, :, :3, 3], frames.shape[1] - 2
    center = points[:, :1]
    if n_joints < 3 or np.abs(points - center).max() > COINCIDENT * size:
        return frames, points[:, :-1]
    arms = frames[:, :n_joints, :3, 2] * (size * np.linspace(*SPHERE, n_joints))[:, None]
    arranged = frames.copy()
    arranged[:, :n_joints, :3, 3] += arms
    arranged[:, n_joints:, :3, 3] = arranged[:, n_joints - 1, None, :3, 3]
    share = np.linspace(0.0, 1.0, 13)[:, None]
    first, second = arms[:, :-1, None], arms[:, 1:, None]
    chords = (1 - share) * first + share * second
    lengths = [np.linalg.norm(arm, axis=-1, keepdims=True) for arm in (first, second, chords)]
    radius = (1 - share) * lengths[0] + share * lengths[1]
    arcs = chords * (radius / np.maximum(lengths[2], 1e-9 * size))
    return arranged, center + arcs.reshape(len(frames), -1, 3)


def _list_joints(robot: Mechanism, i: int, frames: FloatArray) -> Iterator[Part]:
    """Yield joints and rod of limb i with frames (n, J + 2, 4, 4)."""
    limb, points = robot.assembly.limbs[i], frames[:, :, :3, 3]
    for j, joint in enumerate(limb.joints):
        axis, is_driven = frames[:, j, :3, 2], bool(joint.actuator)
        if joint.kind == "P":
            slid = ((points[:, j + 1] - points[:, j]) * axis).sum(axis=1)
            reach = GUIDE * robot.size
            ends = np.stack([np.minimum(slid, 0.0) - reach, np.maximum(slid, 0.0) + reach], axis=1)
            yield Part("guide", points[:, j, None] + ends[:, :, None] * axis[:, None], i)
            yield Part("slide", (points[:, j] + slid[:, None] * axis)[:, None], i, is_driven)
        else:
            ends = np.array([[-1.0], [1.0]]) * AXIS * robot.size
            yield Part("axis", points[:, j, None] + ends * axis[:, None], i)
            yield Part("joint", points[:, j, None], i, is_driven)
    if limb.ending == "distance":
        is_driven, rod = bool(limb.actuator), points[:, -2:]
        is_cable = any(
            actuator.name == limb.actuator and actuator.dimension is Dimension.ANGLE
            for actuator in robot.actuators
        )
        yield Part("cable" if is_cable else "rod", rod, i, is_driven)
        if is_driven and not is_cable:
            yield Part("end", rod[:, :1], i)
        place = rod.mean(axis=1, keepdims=True) if is_driven and not is_cable else rod[:, :1]
        yield Part("rod drive", place, i, is_driven)
    if limb.ending != "rigid":
        yield Part("end", points[:, -1:], i)


def _list_triangles(robot: Mechanism, state: State) -> Iterator[Part]:
    """Yield the linear actuators that turn joints through two anchors."""
    for anchors in locate_anchors(robot, state):
        foot, head = np.moveaxis(anchors.points, 1, 0)
        yield Part("arm", np.stack([foot, anchors.pin, head], axis=1))
        yield Part("rod", anchors.points, anchors.limb, True)
        yield Part("rod drive", anchors.points.mean(axis=1, keepdims=True), anchors.limb, True)
        yield Part("end", anchors.points[:, 1:], anchors.limb)


def _list_bodies(
    robot: Mechanism, foot: FloatArray, top: FloatArray, T: FloatArray
) -> Iterator[Part]:
    """Yield base and platforms of points (n, k, 3), the frames of base and tool, and the tool."""
    for role, points in _list_outlines(robot, foot, top):
        yield Part(role, points[:, _order_outline(points[0])])
    tool = T @ robot.tool
    yield Part("arm", np.stack([T[:, :3, 3], tool[:, :3, 3]], axis=1))
    for frame in (np.broadcast_to(np.eye(4), T.shape), tool):
        for axis in range(3):
            end = frame[:, :3, 3] + 2 * AXIS * robot.size * frame[:, :3, axis]
            yield Part("frame", np.stack([frame[:, :3, 3], end], axis=1), axis)
    yield Part("tool", tool[:, None, :3, 3])


def _list_outlines(
    robot: Mechanism, foot: FloatArray, top: FloatArray
) -> Iterator[tuple[Role, FloatArray]]:
    """Yield the points (n, k, 3) of base, platforms and other bodies.

    A body has the points at which limbs begin and end on it; the platform of a stage those of the
    stages that it carries, too.
    """
    stages = robot.stages
    counts = [len(stage.robot.assembly.limbs) for stage in stages] or [len(robot.assembly.limbs)]
    parents = [stage.parent for stage in stages] or [-1]
    points: dict[tuple[int, str], list[FloatArray]] = {}
    for i, owner in enumerate(np.repeat(np.arange(len(counts)), counts).tolist()):
        limb = robot.assembly.limbs[i]
        for body, point in ((limb.on, foot[:, i]), (limb.to, top[:, i])):
            key = (parents[owner], PLATFORM) if body == BASE else (owner, body)
            points.setdefault(key, []).append(point)
    for (owner, _), own in points.items():
        yield "base" if owner < 0 else "platform", np.stack(own, axis=1)


def _order_outline(points: FloatArray) -> IntArray:
    """Return the order of points (n, 3) by angle about their center, the first again at the end;
    of points on a line their own order.
    """
    offset = points - points.mean(axis=0)
    _, s, V = np.linalg.svd(offset, full_matrices=True)
    if len(points) < 3 or s[1] < 1e-6 * max(s[0], 1e-300):
        return np.arange(len(points))
    normal = V[2] * np.sign(V[2, np.argmax(np.abs(V[2]))])
    size = np.linalg.norm(offset, axis=1)
    first = offset[np.argmax(size > 0.5 * size.max())]  # two similar robots have one order
    angle = np.arctan2(offset @ np.cross(normal, first), offset @ first)
    order = np.argsort(np.where(angle < -COINCIDENT, angle + 2.0 * np.pi, angle))
    return np.append(order, order[0])


# A scene as JSON for the script of the 3-D view (tools/viewer).

SCRIPT = Path(__file__).parent / "viewer.min.js"
MOST_NUMBERS = 200_000  # coordinates of robots at measured poses in one scene: 1.1 MB of text

BODY, BLACK, DRIVEN, UNBOUNDED = "#404040", "#000000", "#666666", "#8c8c8c"
"""Colors of the platform, of axes and the tool, of the legend of driven parts, and of poses whose
uncertainty is not bounded.
"""


@cache
def load_script() -> str:
    """Return the script of the 3-D view."""
    return SCRIPT.read_text("utf-8")


def choose_rows(robot: Mechanism, count: int) -> IntArray:
    """Return the rows, of so many, at which the robot can be shown: all, or evenly spread ones."""
    numbers = 3 * sum(part.points.shape[1] for part in list_parts(robot, robot.home_state))
    return choose_evenly(count, max(1, MOST_NUMBERS // numbers))


def format_scene(scene: Scene) -> str:
    """Return a scene as JSON in which no text can end a script element."""
    robot = scene.robot
    unit = find_unit(robot.units[Dimension.LENGTH])
    parts = list_parts(robot, robot.home_state)
    data = {
        "name": escape(robot.name),
        "unit": unit.symbol,
        "size": robot.size / unit.factor_to_si,
        "planar": is_planar(robot),
        "parts": [describe_part(part) for part in parts],
        "home": _encode(_join(parts) / unit.factor_to_si),
        "names": _list_names(robot, parts, unit),
        "poses": _describe_poses(scene, unit),
        "map": _describe_map(scene, unit),
        "motions": [
            {
                "name": escape(motion.name),
                "text": escape(motion.text),
                "shift": _encode(motion.magnification * motion.shift / unit.factor_to_si),
                "magnification": motion.magnification,
            }
            for motion in scene.motions
        ],
        "legend": _list_legend(scene, parts),
    }
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _encode(values: FloatArray) -> str:
    """Return numbers as base64 of 32-bit floats, the lowest byte first."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def _join(parts: tuple[Part, ...]) -> FloatArray:
    """Return the points of parts (n, P, 3), one part behind the other."""
    return np.concatenate([part.points for part in parts], axis=1)


def describe_part(part: Part) -> dict[str, Any]:
    """Return how a part is drawn."""
    colors = {"axis": BLACK, "tool": BLACK, "platform": BODY, "arm": BODY, "base": "#8a94a0"}
    color = COLORS[part.index % len(COLORS)] if part.index >= 0 else BODY
    if part.role == "frame":
        color = FRAME_COLORS[part.index]
    return {
        "role": part.role,
        "color": colors.get(part.role, color),
        "count": part.points.shape[1],
        "filled": part.is_driven or part.role == "tool",
        "shape": "box" if part.role == "slide" else "ball",
    }


def _list_names(robot: Mechanism, parts: tuple[Part, ...], unit: Unit) -> list[dict[str, Any]]:
    """Return names beside the feet of limbs, and of the axes of the base frame."""
    feet = zip(robot.assembly.limbs, parts, strict=False)
    marks = [(limb.name, describe_part(part)["color"], part.points[0, 0]) for limb, part in feet]
    axes = (part.points[0, 1] for part in parts if part.role == "frame")
    names, factor = "xy" if is_planar(robot) else "xyz", unit.factor_to_si
    marks += zip(names, FRAME_COLORS, axes, strict=False)
    return [
        {"text": escape(name), "color": color, "point": np.round(place / factor, 6).tolist()}
        for name, color, place in marks
    ]


def _describe_poses(scene: Scene, unit: Unit) -> dict[str, Any]:
    """Return measured poses with errors; those of a scene without are empty."""
    robot, poses, rows = scene.robot, scene.poses, np.arange(0)
    labels, magnification = (), 1.0
    tools = errors = robots = np.zeros((0, 3))
    if poses is not None:
        rows, magnification = choose_rows(robot, len(poses.tool)), poses.magnification
        labels, tools, errors = poses.labels, poses.tool, poses.error
        if len(rows):
            robots = _join(list_parts(robot, poses.solution.take(rows).state))
    return {
        "labels": [escape(labels[i]) for i in rows],
        "rows": rows.tolist(),
        "robots": _encode(robots / unit.factor_to_si),
        "tools": _encode(tools / unit.factor_to_si),
        "errors": _encode(errors / unit.factor_to_si),
        "magnification": magnification,
        "colors": {"pose": POSE, "error": ERROR},
    }


def _describe_map(scene: Scene, unit: Unit) -> dict[str, Any] | None:
    """Return the reached poses of the accuracy map with their colors, the triangles of the solid
    around them, and the place of the largest uncertainty.
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize, to_hex

    points, (values, length) = scene.map_points, scene.map_values
    reached, known = np.isfinite(points).all(axis=1), np.isfinite(values)
    if not (reached & known).any():
        return None
    scale = Normalize(values[known].min(), values[known].max())
    shades = [
        to_hex(colormaps[SEQUENTIAL](scale(value))) if np.isfinite(value) else UNBOUNDED
        for value in values[reached]
    ]
    shown, values = points[reached], np.where(known, values, -1.0)[reached]
    largest, hull = int(np.argmax(values)), np.zeros((0, 3), dtype=int)
    if len(shown) > 3 and np.linalg.matrix_rank(shown - shown[0], tol=1e-3 * scene.robot.size) == 3:
        from scipy.spatial import ConvexHull

        hull = ConvexHull(shown).simplices
    most = f"largest: {format_number(values[largest], 2)} {length.symbol}"
    return {
        "points": _encode(shown / unit.factor_to_si),
        "colors": shades,
        "hull": hull.ravel().tolist(),
        "largest": {"index": largest, "text": most},
    }


def _list_legend(scene: Scene, parts: tuple[Part, ...]) -> list[dict[str, str]]:
    """Return the colors of the scene and their meaning, with the scale of the accuracy map."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    robot, poses = scene.robot, scene.poses
    platforms = (part.points[0] for part in parts if part.role == "platform")
    has_platform = any(np.ptp(points, axis=0).max() > 1e-6 * robot.size for points in platforms)
    has_axes = any(part.role == "axis" for part in parts) and not is_planar(robot)
    rows = [
        (BODY, "platform", has_platform),
        (BLACK, "tool", True),
        (BLACK, "axis of a revolute joint", has_axes),
        (DRIVEN, "driven: larger, in the color of its limb", True),
    ]
    if poses is not None:
        error = f"position error before calibration, {poses.magnification:g} times magnified"
        rows += [(POSE, "tool at a measured pose", len(poses.tool) > 0)]
        rows += [(ERROR, error, len(poses.tool) > 0)]
    values, unit = scene.map_values
    if len(known := values[np.isfinite(values)]):
        stops = [to_hex(colormaps[SEQUENTIAL](share)) for share in np.linspace(0.0, 1.0, 5)]
        ends = " to ".join(f"{value:.3g}" for value in (known.min(), known.max()))
        text = f"position uncertainty (rms) over the workspace, {ends} {unit.symbol}"
        rows += [(f"linear-gradient(to right, {', '.join(stops)})", text, True)]
        rows += [(UNBOUNDED, "uncertainty not bounded by the data", len(known) < len(values))]
    return [{"color": color, "text": text} for color, text, is_drawn in rows if is_drawn]


# A scene as a picture.

FLAT = 0.05  # width of an upright plane that contains a machine, as a share of its largest extent
# Room around the second view for names of limbs, as a share of the machine's larger extent.
MARGIN = 0.08
# Directions of the second view, by the axes that it shows.
VIEWS = {(0, 1): "from above", (0, 2): "from the side", (1, 2): "from the front"}


@register("figure", Mechanism)
def draw_robot(robot: Mechanism) -> Figure:
    """Draw a robot at home, in the length unit of its file."""
    length, limbs = find_unit(robot.units[Dimension.LENGTH]), robot.assembly.limbs
    parts = list_parts(robot, robot.home_state)
    strokes = [  # lines or points (n, 3), and the arguments of matplotlib's `plot`
        (part.points[0] / length.factor_to_si, _choose_style(part)) for part in parts
    ]
    everything = np.concatenate([points for points, _ in strokes])
    low, high = everything.min(axis=0), everything.max(axis=0)
    is_flat, shown = is_planar(robot), [*choose_view(robot)]
    figure = start_figure(6.2 if is_flat else 9.8, 5.6 if is_flat else 5.0)
    space: Any = None if is_flat else figure.add_subplot(1, 2, 1, projection="3d")
    above: Any = figure.add_subplot() if is_flat else figure.add_subplot(1, 2, 2)
    panels = [(above, shown)] + ([] if space is None else [(space, [0, 1, 2])])
    for axes, kept in panels:
        for points, style in strokes:
            axes.plot(*points.T[kept], **style)
    middle = np.mean([points[0] for points, _ in strokes[: len(limbs)]], axis=0)
    for (points, style), limb in zip(strokes, limbs, strict=False):  # first the lines of limbs
        _name_limb(above, points[:, shown], limb.name, middle[shown], style["color"])
        if space is not None:
            name, place = f"  {limb.name}", points[0]
            space.text(*place, name, fontsize=SMALL, color=style["color"], zorder=9)
    _finish(space, above, low, high, length.symbol, shown)
    _label_parts(above, parts, "xy" if is_flat else "xyz")
    add_legend(figure)
    counts = {
        "limb": len(limbs),
        "joint": sum(len(limb.joints) for limb in limbs),
        "rod": sum(limb.ending == "distance" for limb in limbs),
        "actuator": len(robot.actuators),
    }
    words = ", ".join(name_count(n, what) for what, n in counts.items() if n)
    return finish_figure(figure, f"{robot.name} at home: {words}; lengths in {length.symbol}")


def choose_view(robot: Mechanism) -> tuple[int, int]:
    """Return the axes of the second view: x and y, or of the upright plane that holds all limbs."""
    parts = list_parts(robot, robot.home_state)
    points = np.concatenate([part.points[0] for part in parts if part.role in ("limb", "rod")])
    extent = np.ptp(points, axis=0)
    for hidden, axes in ((1, (0, 2)), (0, (1, 2))):
        if extent[hidden] < FLAT * extent.max():
            return axes
    return (0, 1)


def _choose_style(part: Part) -> dict[str, Any]:
    """Return how a part is drawn."""
    color = COLORS[part.index % len(COLORS)]
    face = color if part.is_driven else "white"
    styles: dict[Role, dict[str, Any]] = {
        "limb": {"color": color, "lw": 2.5, "solid_capstyle": "round"},
        "axis": {"color": "black", "lw": 1.2},
        "guide": {"color": color, "lw": 1.0, "ls": (0, (4, 3))},
        "joint": _dot("o", color, face, 8.0 if part.is_driven else 5.0),
        "slide": _dot("s", color, face, 8.0 if part.is_driven else 5.0),
        "rod": {"color": color, "lw": 1.6},
        "cable": {"color": color, "lw": 1.0},
        "rod drive": _dot("D", color, face),
        "end": _dot("o", color, "white"),
        "base": {"color": "0.6", "lw": 1.0, "ls": ":", "zorder": 0.5},
        "platform": {"color": DARK, "lw": 2.0},
        "arm": {"color": DARK, "lw": 1.0},
        "frame": {"color": FRAME_COLORS[part.index % 3], "lw": 1.4},
        "tool": _dot("*", "black", "black", 8.0),
    }
    return styles[part.role]


def _dot(marker: str, edge: str, face: str, size: float = 5.0) -> dict[str, Any]:
    return {"marker": marker, "ls": "none", "ms": size, "mec": edge, "mfc": face, "mew": 1.2}


def _name_limb(axes: Any, points: FloatArray, name: str, middle: FloatArray, color: str) -> None:
    """Write the name of a limb beside its foot: away from the middle (2,), or diagonally where the
    limb points (n, 2) away from the middle, too.
    """
    away = points[0] - middle
    if (points[-1] - points[0]) @ away > 0.0:
        away = np.array([away[0] - away[1], away[0] + away[1]])
    distance = float(np.linalg.norm(away))
    place = tuple(np.array([20.0, 13.0]) * (away / distance if distance > 0 else [1.0, 1.0]))
    axes.annotate(
        name, tuple(points[0]), place, textcoords="offset points", ha="center", va="center",
        fontsize=8, color=color,
        bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7},
    )  # fmt: skip


def _finish(
    space: Any, above: Any, low: FloatArray, high: FloatArray, symbol: str, shown: list[int]
) -> None:
    """Set equal scales, and units on all axes."""
    room = MARGIN * (high - low)[shown].max()  # for names beside the outermost feet
    above.update_datalim([(low - room)[shown], (high + room)[shown]])
    above.set_aspect("equal", adjustable="datalim")
    above.autoscale_view()
    across, up = (f"{'xyz'[axis]} [{symbol}]" for axis in shown)
    if space is None:
        label_axes(above, across, up)
        return
    label_axes(above, across, up, VIEWS[shown[0], shown[1]])
    middle, reach = (low + high) / 2, np.maximum(high - low, 0.15 * (high - low).max()) * 0.55
    for axis, m, r in zip("xyz", middle, reach, strict=True):
        getattr(space, f"set_{axis}lim")(m - r, m + r)
        getattr(space, f"set_{axis}label")(f"{axis} [{symbol}]", fontsize=LABEL)
    space.set_box_aspect(reach, zoom=0.9)
    space.view_init(elev=22, azim=-58)
    space.tick_params(labelsize=7)
    space.locator_params(nbins=5)
    space.set_title("perspective", fontsize=LABEL)


def _label_parts(axes: Axes, parts: tuple[Part, ...], names: str) -> None:
    """Label everything that a picture contains, for its legend; `names` of the axes of frames."""
    roles, driven = {part.role for part in parts}, {part.role for part in parts if part.is_driven}
    marker = "s" if "slide" in driven else "o" if "joint" in driven else "D"
    guide = {"color": "0.4", "lw": 1.0, "ls": (0, (4, 3))}
    of_frames = zip(names, FRAME_COLORS, strict=False)
    has_axes = "axis" in roles and names == "xyz"
    rows: list[tuple[str, bool, dict[str, Any]]] = [
        ("axis of a revolute joint", has_axes, {"color": "black", "lw": 1.2}),
        ("guide of a sliding joint", "guide" in roles, guide),
        ("rod", not roles.isdisjoint(("rod", "cable")), {"color": "0.4", "lw": 1.6}),
        ("driven, filled", True, _dot(marker, "0.4", "0.4")),
        ("platform", True, {"color": "0.25", "lw": 2.0}),
        ("tool", True, _dot("*", "black", "black", 8.0)),
        *((f"{name} of base and tool", True, {"color": c, "lw": 1.4}) for name, c in of_frames),
    ]
    for label, is_drawn, style in rows:
        if is_drawn:
            axes.plot([], [], label=label, **style)


def draw_scene(scene: Scene) -> Figure:
    """Draw a robot at home; with measured poses the tool points and errors there; with an accuracy
    map the uncertainty of positions over the workspace as pale points.
    """
    robot, poses, figure = scene.robot, scene.poses, draw_robot(scene.robot)
    factor, flat = find_unit(robot.units[Dimension.LENGTH]).factor_to_si, [*choose_view(robot)]
    panels = [(axes, [0, 1, 2] if axes.name == "3d" else flat) for axes in figure.axes]
    if scene.accuracy is not None:
        _draw_map(figure, panels, scene, factor)
    if poses is None:
        return figure
    tips = poses.tool + poses.magnification * poses.error
    gaps = np.full(poses.tool.shape, np.nan)  # between the lines from tools to tips
    lines = np.stack([poses.tool, tips, gaps], axis=1).reshape(-1, 3) / factor
    for axes, kept in panels:
        axes.plot(*lines[:, kept].T, color=ERROR, lw=1.0, zorder=8)
        axes.plot(*poses.tool[:, kept].T / factor, "o", color=POSE, ms=2.5, zorder=8)
        if axes.name == "3d" and len(lines):
            _include(axes, lines)
    count = name_count(len(poses.tool), "measured pose")
    title = f"{robot.name} at home, {count}; errors before calibration"
    return finish_figure(figure, f"{title}, x {poses.magnification:g}")


def _draw_map(
    figure: Figure, panels: list[tuple[Any, list[int]]], scene: Scene, factor: float
) -> None:
    """Draw the uncertainty of positions where it is known, with its scale of colors."""
    values, unit = scene.map_values
    known = np.isfinite(values) & np.isfinite(scene.map_points).all(axis=1)
    if not known.any():
        return
    points, drawn = scene.map_points[known] / factor, None
    style: dict[str, Any] = {"cmap": SEQUENTIAL, "s": 9.0, "marker": "s", "lw": 0.0, "alpha": 0.45}
    for axes, kept in panels:
        drawn = axes.scatter(*points[:, kept].T, c=values[known], zorder=0.4, **style)
        if axes.name == "3d":
            _include(axes, points)
    label = f"position uncertainty (rms) [{unit.symbol}]"
    bar = add_colorbar(figure, drawn, panels[-1][0], label, aspect=30, pad=0.02, shrink=0.8)
    bar.ax.tick_params(width=THIN)
    bar.solids.set_alpha(1.0)


def _include(axes: Any, points: FloatArray) -> None:
    """Widen the limits of axes in space so that they contain points; scales stay equal."""
    spans = []
    for axis, values in zip("xyz", points.T, strict=True):
        low, high = getattr(axes, f"get_{axis}lim")()
        low, high = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
        getattr(axes, f"set_{axis}lim")(low, high)
        spans.append(high - low)
    axes.set_box_aspect(spans, zoom=0.9)
