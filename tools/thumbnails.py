# SPDX-License-Identifier: Apache-2.0
"""Draw docs/pictures/thumbnails: for each example of the gallery one subject, readable at 200 px.

Each is drawn from the values that the example itself computes, and not from its figures, which are
made for the width of a page. The gallery and the first page of the documentation show them.

python -m tools.thumbnails            all of them
python -m tools.thumbnails plot_study these only
"""

import argparse
import runpy
import sys
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import loopcal as lc
from loopcal.report.figures.style import COLORS, DARK, SEQUENTIAL
from loopcal.report.scene.scene import Scene, compute_motion, list_parts
from tools.rendering import open_renderer, save_picture

ROOT = Path(__file__).resolve().parent.parent
GALLERY, PICTURES = ROOT / "docs" / "gallery", ROOT / "docs" / "pictures" / "thumbnails"
SIZE, DPI = (4.2, 2.8), 150
BIG, MIDDLE = 24, 17  # sizes of texts [pt]
BLUE, ORANGE, GREEN = COLORS[:3]
PALE = "#c9d1da"

Names = dict[str, Any]
"""The variables of an example."""

DRAWINGS: dict[str, Callable[[Figure, Names], None]] = {}


def thumbnail(function: Callable[[Figure, Names], None]) -> Callable[[Figure, Names], None]:
    """Register the drawing of the example that has the name of the function."""
    DRAWINGS[f"plot_{function.__name__}"] = function
    return function


def fill(figure: Figure, **how: Any) -> Any:
    """Return axes over the whole figure, without frame."""
    axes = figure.add_axes((0.03, 0.04, 0.94, 0.92), **how)
    axes.set_axis_off()
    return axes


def write(figure: Figure, text: str, x: float = 0.05, y: float = 0.86, **how: Any) -> None:
    """Write a few large words."""
    figure.text(x, y, text, **{"fontsize": MIDDLE, "color": DARK, **how})


def render(figure: Figure, names: Names, keys: str, second: str = "machine") -> None:
    """Show the nominal robot of an example, and its true machine magnified in color."""
    robot = names["robot"]
    motion = compute_motion(robot, names[second].values - robot.values, "", "")
    assert motion
    with open_renderer() as draw:
        picture = draw(Scene(robot, motions=(motion,)), 420, keys=keys, names=False, color=ORANGE)
    figure.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False, xticks=[], yticks=[]).imshow(picture)


@thumbnail
def hexapod_tracker(figure: Figure, names: Names) -> None:
    """Draw a hexapod and its errors."""
    render(figure, names, "ArrowUp + +")


@thumbnail
def tilt_meter(figure: Figure, names: Names) -> None:
    """Draw a tripod and its errors."""
    render(figure, names, "ArrowUp + +")


@thumbnail
def cable_readings(figure: Figure, names: Names) -> None:
    """Draw a cable robot and its errors."""
    render(figure, names, "ArrowUp ArrowUp ArrowUp +")


@thumbnail
def own_mechanism(figure: Figure, names: Names) -> None:
    """Draw a plotter of two slides and two rods."""
    axes, robot = fill(figure), names["robot"]
    axes.plot(*(names["sheet"].coordinates[:, :2].T), "o", color=PALE, ms=5)
    for part in list_parts(robot, robot.home_state):
        x, y = part.points[0, :, :2].T
        color = COLORS[part.index % len(COLORS)]
        if part.role == "guide":
            axes.plot(x, y, color=color, lw=3, ls=(0, (2, 1)))
        elif part.role in ("limb", "rod"):
            axes.plot(x, y, color=color, lw=7, solid_capstyle="round")
        elif part.role in ("slide", "tool"):
            axes.plot(x, y, "s" if part.role == "slide" else "o", color=DARK, ms=16)
    axes.set_aspect("equal")


@thumbnail
def ball_bar(figure: Figure, names: Names) -> None:
    """Draw ball bars from three places to all poses."""
    axes, poses = fill(figure), names["poses"]
    for k, sensor in enumerate(names["bar"].sensors):
        anchor, rows = sensor.kind.anchor, sensor.rows
        for ball in poses[rows, :2]:
            axes.plot(*np.transpose([anchor[:2], ball]), color=COLORS[k], lw=1.6, alpha=0.6)
        axes.plot(*poses[rows, :2].T, "o", color=COLORS[k], ms=6)
        axes.plot(*anchor[:2], "o", color=COLORS[k], ms=22, mec=DARK, mew=3)
    axes.set_aspect("equal", adjustable="datalim")


@thumbnail
def datum_cube(figure: Figure, names: Names) -> None:
    """Draw a cube with the points that a probe touches."""
    axes = fill(figure, projection="3d")
    half = names["EDGE"] / 2
    for low, high in _list_edges(half):
        axes.plot(*np.transpose([low, high]), color=DARK, lw=3.5)
    tips = np.array(names["coordinates"])[:, :3] - names["CENTER"]
    for k, first in enumerate(range(0, len(tips), 12)):
        axes.plot(*tips[first : first + 12].T, "o", color=COLORS[k], ms=9)
    axes.set_box_aspect((1, 1, 1), zoom=1.15)
    axes.view_init(elev=24, azim=-52)


def _list_edges(half: float) -> list[tuple[Any, Any]]:
    """Return the edges of a cube about the origin, as pairs of corners."""
    corners = np.array(np.meshgrid(*[[-half, half]] * 3)).reshape(3, -1).T
    pairs = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :]]
    return [(a, b) for a, b in pairs if np.count_nonzero(a != b) == 1]


@thumbnail
def dial_gauge(figure: Figure, names: Names) -> None:
    """Draw how many combinations of parameters are determined."""
    result = names["result"]
    axes = figure.add_axes((0.06, 0.3, 0.88, 0.42))
    for i in range(result.n_parameters):
        axes.bar(i, 1.0, 0.8, color=BLUE if i < result.rank else PALE)
    axes.set_axis_off()
    write(figure, f"{result.rank} of {result.n_parameters}", 0.06, 0.8, fontsize=BIG, color=BLUE)
    write(figure, "can be determined", 0.06, 0.1)


@thumbnail
def accuracy_map(figure: Figure, names: Names) -> None:
    """Draw the uncertainty over the workspace beside the measured poses."""
    accuracy, axes = names["accuracy"], fill(figure)
    values = accuracy.uncertainty.position
    order = np.argsort(values)
    axes.scatter(*accuracy.coordinates[order, :2].T, c=values[order], s=190, cmap=SEQUENTIAL)
    axes.plot(*names["inner"][:, :2].T, "x", color="white", ms=10, mew=3)
    axes.set_aspect("equal", adjustable="datalim")


@thumbnail
def planning(figure: Figure, names: Names) -> None:
    """Draw planned and held-out poses in the workspace."""
    plan, robot = names["plan"], names["robot"]
    axes = fill(figure, projection="3d")
    some = lc.sample_workspace(robot, 300, seed=2).coordinates
    axes.plot(*some.T, "o", color=PALE, ms=4)
    chosen, held_out = plan.poses.coordinates, plan.poses.held_out
    axes.plot(*chosen[~held_out].T, "o", color=BLUE, ms=13, mec="white")
    axes.plot(*chosen[held_out].T, "o", color=ORANGE, ms=13, mec="white")
    axes.set_box_aspect((1.5, 1.5, 1), zoom=1.3)


@thumbnail
def repeatability(figure: Figure, names: Names) -> None:
    """Draw the visits of one pose, and its commanded position."""
    axes = fill(figure)
    reached = (names["measured"].observations[0].measured - names["commanded"])[:30, :2] * 1e6
    middle = reached.mean(axis=0)
    radius = np.linalg.norm(reached - middle, axis=1)
    limit = radius.mean() + 3 * radius.std(ddof=1)
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = middle[:, None] + limit * np.array([np.cos(angle), np.sin(angle)])
    axes.fill(*circle, color=BLUE, alpha=0.18)
    axes.plot(*circle, color=BLUE, lw=3)
    axes.plot(*reached.T, "o", color=BLUE, ms=7)
    style = {"arrowstyle": "-|>", "lw": 3.5, "color": ORANGE, "mutation_scale": 26}
    axes.annotate("", tuple(middle), (0.0, 0.0), arrowprops=style)
    axes.plot(0, 0, "+", color=DARK, ms=26, mew=4)
    axes.set_aspect("equal", adjustable="datalim")


@thumbnail
def two_sessions(figure: Figure, names: Names) -> None:
    """Draw the shift of each parameter, one of which has changed."""
    axes, pair = fill(figure), names["comparison"].pairs[0]
    parameters = names["robot"].parameters.names
    shifts = [pair.find_shift(name) for name in parameters]
    sizes = [shift / sd if sd > 0 else np.nan for shift, sd, _ in shifts]
    colors = [ORANGE if name == names["moved"] else PALE for name in parameters]
    axes.bar(range(len(sizes)), sizes, 0.8, color=colors)
    axes.axhline(0.0, color=DARK, lw=2)
    write(figure, names["moved"].replace(".", "\n"), 0.06, 0.6, color=ORANGE)


@thumbnail
def own_estimator(figure: Figure, names: Names) -> None:
    """Draw errors of poses, three of which are wrong."""
    axes, fit = fill(figure), names["robust"]
    place = lc.forward(fit.robot, names["data"].readings).T[:, :2, 3]
    errors = np.linalg.norm(names["wrong"] - place, axis=1) * 1e6
    is_wrong = np.isin(np.arange(len(errors)), [4, 17, 30])
    for chosen, color, size in ((~is_wrong, BLUE, 9), (is_wrong, ORANGE, 16)):
        axes.plot(np.flatnonzero(chosen), errors[chosen], "o", color=color, ms=size)
    axes.axhline(0.0, color=DARK, lw=2)
    axes.margins(0.04, 0.12)


@thumbnail
def study(figure: Figure, names: Names) -> None:
    """Draw errors over the number of points with two cameras."""
    axes = figure.add_axes((0.04, 0.2, 0.66, 0.72))
    table = names["result"].to_frame()
    lines = table.groupby(["noise", "poses"])["position_max"].mean().unstack()
    last = 0.0
    for k, (noise, errors) in enumerate(lines.iterrows()):
        axes.plot(range(len(errors)), errors, "o-", color=COLORS[k], lw=5, ms=12)
        last = float(errors.iloc[-1])
        axes.annotate(
            f"{20 * float(str(noise)):.0f} um", (len(errors) - 1, last), (14, 0),
            textcoords="offset points", fontsize=MIDDLE, color=COLORS[k], va="center",
            annotation_clip=False,
        )  # fmt: skip
    axes.set_xticks(range(lines.shape[1]), lines.columns, fontsize=MIDDLE)
    axes.set_yscale("log")
    axes.tick_params(length=0)
    for is_minor in (False, True):
        axes.set_yticks([], minor=is_minor)
    axes.spines[["top", "right", "left"]].set_visible(False)


@thumbnail
def klipper(figure: Figure, names: Names) -> None:
    """Draw the bowl that a printer sees."""
    heights = lc.forward(names["nominal"], names["carriages"]).T[:, 2, 3] - names["touched"]
    points = names["points"]
    _draw_bed(figure, points.real, points.imag, heights)


@thumbnail
def reprap(figure: Figure, names: Names) -> None:
    """Draw the height errors over the bed."""
    axes = fill(figure)
    x, y = names["points"].T
    limit = np.abs(names["heights"]).max()
    axes.add_artist(_circle(85.0))
    style = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "ec": DARK, "lw": 1.5}
    axes.scatter(x, y, c=names["heights"], s=420, **style)
    axes.set(xlim=(-130, 130), ylim=(-90, 90))
    axes.set_aspect("equal")


def _circle(radius: float) -> Any:
    from matplotlib.patches import Circle

    return Circle((0, 0), radius, fc="#eef1f5", ec=DARK, lw=3)


def _draw_bed(figure: Figure, x: Any, y: Any, heights: Any) -> None:
    """Draw the bed as a printer sees it through its errors, with heights much enlarged."""
    from matplotlib.tri import Triangulation, UniformTriRefiner

    axes: Any = figure.add_axes((-0.25, -0.4, 1.5, 1.8), projection="3d")
    axes.set_axis_off()
    smooth, z = UniformTriRefiner(Triangulation(x, y)).refine_field(heights, subdiv=3)
    axes.plot_trisurf(smooth, z, cmap="RdBu_r", lw=0.0, antialiased=False)
    axes.scatter(x, y, heights, color=DARK, s=28, depthshade=False)
    axes.set_box_aspect((1.5, 1.5, 0.7), zoom=1.3)
    axes.view_init(elev=28, azim=-55)


def main() -> int:
    """Draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("examples", nargs="*", help="names of examples; all by default")
    wanted = parser.parse_args().examples or list(DRAWINGS)
    for name in wanted:
        with redirect_stdout(StringIO()), warnings.catch_warnings(action="ignore"):
            names = runpy.run_path(str(GALLERY / f"{name}.py"), run_name="__main__")
        figure = Figure(figsize=SIZE, facecolor="white")
        DRAWINGS[name](figure, names)
        save_picture(PICTURES / f"{name.removeprefix('plot_')}.png", figure, DPI)
        print(name, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
