# SPDX-License-Identifier: Apache-2.0
"""A picture of a mechanism: its limbs, joints, rods, platform and tool, in space and from above.

A limb has the same color in both views. A short line through a point is the axis of a revolute
joint, a dashed line is the guide of a sliding joint, and a filled point is driven. The placement of
links comes from `mechanism.frames`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.mechanism import Mechanism, Solution, compute_limb_frames
from loopcal.report.figures.style import (
    COLORS,
    LABEL,
    SMALL,
    add_legend,
    finish_figure,
    label_axes,
    start_figure,
)
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXIS, GUIDE = 0.06, 0.12
"""Half the length of the axis of a revolute joint, and the length of a guide beyond its slide, both
as a share of the robot's size.
"""


PLANAR = {"x", "y", "rz"}
"""Freedoms of a platform that moves in the x-y plane."""


@dataclass(frozen=True)
class Stroke:
    """A line or points (n, 3) [m] of the picture, with the arguments of matplotlib's `plot`."""

    points: FloatArray
    style: dict[str, Any]


def draw_robot(robot: Mechanism, solution: Solution | None = None, row: int = 0) -> Figure:
    """Draw a robot at home, or at a row of a solution, in the length unit of its file."""
    state = robot.home_state if solution is None else solution.take(np.array([row])).state
    length = find_unit(robot.units[Dimension.LENGTH])
    strokes = list(
        _strokes(
            robot,
            [f[0, 0] for f in compute_limb_frames(robot, robot.values[None], state)],
            state.T[0, 0],
        )
    )
    strokes = [Stroke(s.points / length.factor_to_si, s.style) for s in strokes]
    everything = np.concatenate([s.points for s in strokes])
    low, high = everything.min(axis=0), everything.max(axis=0)

    is_flat = is_planar(robot)
    figure = start_figure(7.0 if is_flat else 11.8, 6.4 if is_flat else 6.0)
    space: Any = None if is_flat else figure.add_subplot(1, 2, 1, projection="3d")
    above: Any = figure.add_subplot() if is_flat else figure.add_subplot(1, 2, 2)
    for stroke in strokes:
        above.plot(*stroke.points.T[:2], **stroke.style)
        if space is not None:
            space.plot(*stroke.points.T, **stroke.style)
    limbs = strokes[: len(robot.assembly.limbs)]
    middle = np.mean([stroke.points[0] for stroke in limbs], axis=0)
    for stroke, limb in zip(limbs, robot.assembly.limbs, strict=True):
        _label(space, above, stroke, limb.name, middle)
    _finish(space, above, low, high, length.symbol)
    where = "at home" if solution is None else f"at row {row}"
    add_legend(figure, _legend(robot))
    return finish_figure(figure, _caption(robot, where, length.symbol))


def is_planar(robot: Mechanism) -> bool:
    """Return whether the platform moves in the x-y plane only: one view shows everything."""
    return set(robot.freedoms) <= PLANAR


def _strokes(robot: Mechanism, limbs: list[FloatArray], T: FloatArray) -> Iterator[Stroke]:
    """Yield everything to draw [m]: a line for each limb, then joints, platform, base and tool."""
    for i, frames in enumerate(limbs):
        chain = frames[:-1, :3, 3]
        yield Stroke(
            chain, {"color": COLORS[i % len(COLORS)], "lw": 2.5, "solid_capstyle": "round"}
        )
    for i, (limb, frames) in enumerate(zip(robot.assembly.limbs, limbs, strict=True)):
        color, points = COLORS[i % len(COLORS)], frames[:, :3, 3]
        for j, joint in enumerate(limb.joints):
            axis, face = frames[j, :3, 2], color if joint.actuator else "white"
            if joint.kind == "P":
                slid = (points[j + 1] - points[j]) @ axis
                ends = np.array(
                    [min(slid, 0.0) - GUIDE * robot.size, max(slid, 0.0) + GUIDE * robot.size]
                )
                yield Stroke(
                    points[j] + ends[:, None] * axis, {"color": color, "lw": 1.0, "ls": (0, (4, 3))}
                )
                place = points[j] + slid * axis
            else:
                place = points[j]
                yield Stroke(
                    place + np.array([[-1.0], [1.0]]) * AXIS * robot.size * axis,
                    {"color": "black", "lw": 1.2},
                )
            yield Stroke(
                place[None],
                _dot(
                    "s" if joint.kind == "P" else "o", color, face, 8.0 if joint.actuator else 5.0
                ),
            )
        if limb.ending == "distance":
            face = color if limb.actuator else "white"
            yield Stroke(points[-2:], {"color": color, "lw": 1.6})
            yield Stroke(
                points[-2:].mean(axis=0)[None] if limb.actuator else points[-2:-1],
                _dot("D", color, face),
            )
        if limb.ending != "rigid":
            yield Stroke(points[-1:], _dot("o", color, "white"))
    yield from _bodies(
        robot, np.array([f[-1, :3, 3] for f in limbs]), np.array([f[0, :3, 3] for f in limbs]), T
    )


def _bodies(robot: Mechanism, top: FloatArray, foot: FloatArray, T: FloatArray) -> Iterator[Stroke]:
    """Yield platform, base, their frames, and the tool."""
    yield Stroke(_outline(foot), {"color": "0.6", "lw": 1.0, "ls": ":", "zorder": 0.5})
    yield Stroke(_outline(top), {"color": "0.25", "lw": 2.0})
    tool = T @ robot.tool
    yield Stroke(np.stack([T[:3, 3], tool[:3, 3]]), {"color": "0.25", "lw": 1.0})
    for frame in (np.eye(4), tool):
        for axis, color in enumerate(("#b22222", "#228b22", "#1e3fae")):
            end = frame[:3, 3] + 2 * AXIS * robot.size * frame[:3, axis]
            yield Stroke(np.stack([frame[:3, 3], end]), {"color": color, "lw": 1.4})
    yield Stroke(tool[None, :3, 3], _dot("*", "black", "black", 8.0))


def _outline(points: FloatArray) -> FloatArray:
    """Return points (n, 3) sorted by angle about their center and closed; unchanged on a line."""
    offset = points - points.mean(axis=0)
    _, s, V = np.linalg.svd(offset, full_matrices=True)
    if len(points) < 3 or s[1] < 1e-6 * max(s[0], 1e-300):
        return points
    order = np.argsort(np.arctan2(offset @ V[1], offset @ V[0]))
    return points[[*order, order[0]]]


def _dot(marker: str, edge: str, face: str, size: float = 5.0) -> dict[str, Any]:
    return {"marker": marker, "ls": "none", "ms": size, "mec": edge, "mfc": face, "mew": 1.2}


def _label(space: Any, above: Any, limb: Stroke, name: str, middle: FloatArray) -> None:
    """Write the name of a limb beside its foot: away from the center, or diagonally where the limb
    points away from the center, too.
    """
    foot = limb.points[0]
    away = foot[:2] - middle[:2]
    if (limb.points[-1] - foot)[:2] @ away > 0.0:
        away = np.array([away[0] - away[1], away[0] + away[1]])
    distance = float(np.linalg.norm(away))
    place = tuple(np.array([20.0, 13.0]) * (away / distance if distance > 0 else [1.0, 1.0]))
    back = {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7}
    above.annotate(
        name,
        foot[:2],
        xytext=place,
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=8,
        color=limb.style["color"],
        bbox=back,
    )
    if space is not None:
        space.text(*foot, f"  {name}", fontsize=SMALL, color=limb.style["color"], zorder=9)


def _finish(space: Any, above: Any, low: FloatArray, high: FloatArray, symbol: str) -> None:
    """Set equal scales, and units on all axes."""
    above.set_aspect("equal", adjustable="datalim")
    above.margins(0.15 if space is None else 0.1)
    if space is None:
        label_axes(above, f"x [{symbol}]", f"y [{symbol}]")
        return
    label_axes(above, f"x [{symbol}]", f"y [{symbol}]", "from above")
    middle, reach = (low + high) / 2, np.maximum(high - low, 0.15 * (high - low).max()) * 0.55
    for axis, m, r in zip("xyz", middle, reach, strict=True):
        getattr(space, f"set_{axis}lim")(m - r, m + r)
        getattr(space, f"set_{axis}label")(f"{axis} [{symbol}]", fontsize=LABEL)
    space.set_box_aspect(reach, zoom=0.9)
    space.view_init(elev=22, azim=-58)
    space.tick_params(labelsize=7)
    space.locator_params(nbins=5)
    space.set_title("perspective", fontsize=LABEL)


def _caption(robot: Mechanism, where: str, symbol: str) -> str:
    """Return name and counts."""
    limbs = robot.assembly.limbs
    counts = {
        "limb": len(limbs),
        "joint": sum(len(limb.joints) for limb in limbs),
        "rod": sum(limb.ending == "distance" for limb in limbs),
        "actuator": len(robot.actuators),
    }
    words = ", ".join(f"{n} {what}{'s' if n > 1 else ''}" for what, n in counts.items() if n)
    return f"{robot.name} {where}: {words}; lengths in {symbol}"


def _legend(robot: Mechanism) -> list[Any]:
    """Return a handle for everything that the picture of a robot contains."""
    from matplotlib.lines import Line2D

    limbs = robot.assembly.limbs
    kinds = {joint.kind for limb in limbs for joint in limb.joints}
    driven = {joint.kind for limb in limbs for joint in limb.joints if joint.actuator}
    marker = "s" if "P" in driven else "o" if driven else "D"
    has_rods = any(limb.ending == "distance" for limb in limbs)
    rows: list[tuple[str, bool, dict[str, Any]]] = [
        (
            "axis of a revolute joint",
            "R" in kinds and not is_planar(robot),
            {"color": "black", "lw": 1.2},
        ),
        ("guide of a sliding joint", "P" in kinds, {"color": "0.4", "lw": 1.0, "ls": (0, (4, 3))}),
        ("rod", has_rods, {"color": "0.4", "lw": 1.6}),
        ("driven, filled", True, _dot(marker, "0.4", "0.4")),
        ("platform", True, {"color": "0.25", "lw": 2.0}),
        ("tool", True, _dot("*", "black", "black", 8.0)),
    ]
    return [Line2D([], [], label=label, **style) for label, is_drawn, style in rows if is_drawn]
