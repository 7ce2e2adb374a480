# SPDX-License-Identifier: Apache-2.0
"""Where a camera stands that looks at a printed board on the platform: its stations.

A station lies in a direction from the middle of the places that the board visits, and so far away
that the picture shows all of these places. The board faces one side of the platform or the other.
The chosen station has the smallest error that is predicted of the tool over the workspace, a
further one with those before. A plan then chooses pictures: poses, each from one of the stations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, EstimationError
from loopcal.findings import Finding, report_finding
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.image import NARROW, PRINT_SD, Image, state_camera
from loopcal.measure.nuisance import StatedValue
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.planning.candidates import draw_candidates
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.pose_planning import Plan
from loopcal.planning.problem import prepare_problem
from loopcal.typing import BoolArray, FloatArray, Progress, report_no_progress
from loopcal.units import Dimension

TILTS = np.radians([10.0, 25.0, 40.0, 55.0])  # between line of sight and normal of the board
AROUND = np.radians(np.arange(0.0, 360.0, 45.0))  # directions about the normal
FILLED = 0.92  # share of a picture that the places of the board fill
DRAWN = 60  # poses by which stations are compared
CLEAR = 30.0  # width of a square in a picture [px], where it is narrow, whose marker is found
CORNERS, USABLE = 8, 0.5  # corners that a picture needs, and share of poses with such pictures
ALIKE = 0.02  # share by which a station may be worse than the best, if it comes before it
SIGMA = 0.1  # standard deviation of a corner in a picture [px]


class View(NamedTuple):
    """How a placed camera sees the board at n poses: its distance (n,) [m], the angle (n,) [deg]
    between its normal and the line of sight, the width (n,) [px] of a square where it looks
    narrowest, the share (n,) of corners in the picture, and whether (n,) the picture can be used.
    """

    camera: Image
    distance: FloatArray
    tilt: FloatArray
    pixels: FloatArray
    shown: FloatArray
    is_usable: BoolArray


def list_stations(
    robot: Mechanism, camera: Image, poses: Solution, place: FloatArray | None = None
) -> Iterator[Image]:
    """Yield placements of a fixed camera, or of one at a place (3,), and of a board that faces one
    side of the platform or the other, which moves to poses.
    """
    middle = _find_middle(camera)
    tools = (poses.T @ robot.tool)[:, :3, 3]
    center = 0.5 * (tools.min(axis=0) + tools.max(axis=0))
    reach = np.linalg.norm(tools - center, axis=1).max() + np.linalg.norm(middle)
    slope = 0.5 * FILLED * min(camera.size) / camera.nominal_lens[0]
    distance = reach * (1.0 + 1.0 / slope)
    step = 10.0 ** np.floor(np.log10(distance / 20.0))  # to which a person places a camera
    home = robot.home[:3, :3]
    for side in (1.0, -1.0):  # where the board faces along the z axis of the platform
        R = np.diag([1.0, -side, -side])  # the z axis of a board leads away from who reads it
        board = geometry.make_pose(R, robot.tool[:3, 3] - R @ middle)
        across = [np.array([np.cos(a), np.sin(a)]) * np.sin(t) for t in TILTS for a in AROUND]
        up = side * np.repeat(np.cos(TILTS), len(AROUND))
        ahead = np.column_stack([across, up]) @ home.T
        stations = np.round((center + distance * ahead) / step) * step + 0.0
        for station in stations if place is None else place[None]:
            yield replace(camera, T_camera=look_at(station, center), T_board=board)


def _find_middle(camera: Image) -> FloatArray:
    """Return the middle (3,) of a board in its own frame."""
    return 0.5 * camera.square * np.array([*(n - 1 for n in camera.corners), 0.0])


def look_at(station: FloatArray, place: FloatArray) -> FloatArray:
    """Return the pose of a camera at a station whose line of sight meets a place, held level."""
    sight = (place - station) / np.linalg.norm(place - station)
    right = np.cross(sight, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    return geometry.make_pose(np.column_stack([right, np.cross(sight, right), sight]), station)


def choose_stations(
    robot: Mechanism,
    camera: Image,
    options: PlanOptions | None = None,
    scales: Sequence[tuple[float, float]] = ((0.0, PRINT_SD),) * 2,
    progress: Progress = report_no_progress,
    count: int = 1,
) -> tuple[Instrument, tuple[Finding, ...]]:
    """Return the instrument with the camera at the best stations, and where these are.

    camera : its lens and the board. scales : of the print, see `state_camera`.
    options : their line of sight fixes the first station. count : of stations.

    DataError : the camera is on the platform, sees no board, or promises no bounded error.
    """
    if camera.mount != "board":
        raise DataError.of("plan.camera-mounted", robot=robot.name)
    options = replace(options or PlanOptions(), allow_fewer_equations=True)
    camera, stated = state_camera(camera, scales)
    candidates, sight = draw_candidates(robot, options.constraints, DRAWN, options.seed), None
    if options.constraints.sight is not None:
        sight = options.constraints.sight.station
    poses, chosen = candidates.solution, list[View]()
    for _ in range(count):
        views = [_watch(at, poses.T) for at in list_stations(robot, camera, poses, sight)]
        usable = _select_usable(views)
        for other in chosen:  # on the same side of the platform, and elsewhere
            usable = [v for v in usable if (v.camera.T_board == other.camera.T_board).all()
                      and (v.camera.T_camera != other.camera.T_camera).any()]  # fmt: skip
        errors = np.full(len(usable), np.inf)
        for i, view in enumerate(usable):
            placed = _equip((*chosen, view), stated)
            with suppress(EstimationError):  # a frame stays open without spreads
                found = prepare_problem(robot, placed, options, candidates)
                after = found.predict_errors(np.arange(len(found.groups.rows)))
                errors[i] = np.inf if after is None else after.select(options.target)
            progress(i + 1, len(usable), "stations of the camera")
        if not np.isfinite(errors).any():
            raise DataError.of("plan.no-station", robot=robot.name)
        chosen.append(usable[int(np.flatnonzero(errors <= (1.0 + ALIKE) * errors.min())[0])])
        sight = None
    return _equip(chosen, stated), tuple(_describe(robot, view) for view in chosen)


def _select_usable(views: Sequence[View]) -> list[View]:
    """Return the views whose pictures can be used, with clear markers if any has these."""
    usable = [view for view in views if view.is_usable.mean() >= USABLE]
    if not usable:
        best = max(views, key=lambda view: view.is_usable.mean())
        shown = 100.0 * float(best.shown.mean())
        pixels, tilt = float(np.median(best.pixels)), float(np.median(best.tilt))
        data: dict[str, Any] = {"shown": shown, "pixels": max(pixels, 0.0), "tilt": tilt}
        raise DataError.of("plan.board-unseen", **data)
    return [view for view in usable if view.pixels.min() >= CLEAR] or usable


def _equip(views: Sequence[View], stated: tuple[StatedValue, ...]) -> Instrument:
    """Return one camera at the stations of views; the first one gives the lens its name."""
    first, *others = (view.camera for view in views)
    kinds = [replace(other, camera=f"{first.camera}{i}", lens=first.lens or first.camera)
             for i, other in enumerate(others, 2)]  # fmt: skip
    noise = Gaussian(np.full(2, SIGMA))
    sensors = tuple(Sensor(kind, noise) for kind in (first, *kinds))
    return Instrument(sensors, stated, has_stations=bool(kinds))


def _watch(camera: Image, poses: FloatArray) -> View:
    """Return how a camera sees the board at poses (n, 4, 4)."""
    T = poses @ camera.T_board
    sight = (T @ [*_find_middle(camera), 1.0])[:, :3] - camera.T_camera[:3, 3]
    distance = np.linalg.norm(sight, axis=1)
    cosine = np.clip((T[:, :3, 2] * sight).sum(axis=1) / distance, -1.0, 1.0)
    pixels = camera.square * camera.nominal_lens[0] / distance * cosine
    each = np.repeat(poses, camera.rows_per_pose, axis=0)[None]
    columns = camera.measure(each, np.zeros((1, each.shape[1], 2)))
    seen = camera.hide_unseen(each, columns, camera.nominal_values[None, None])
    corners = camera.detect_present(seen).reshape(len(T), -1, 2).all(axis=2).sum(axis=1)
    is_usable = (corners >= min(CORNERS, camera.rows_per_pose)) & (pixels >= NARROW)
    tilt = np.degrees(np.arccos(cosine))
    return View(camera, distance, tilt, pixels, corners / camera.rows_per_pose, is_usable)


def _describe(robot: Mechanism, view: View) -> Finding:
    """Return where the camera stands, and how it sees the board."""
    camera, pixels, tilts = view.camera, view.pixels, view.tilt
    return report_finding(
        "plan.camera-station",
        place=tuple(robot.to_quantity(float(x), Dimension.LENGTH) for x in camera.T_camera[:3, 3]),
        distance=robot.to_quantity(float(np.median(view.distance)), Dimension.LENGTH),
        side="-z" if camera.T_board[2, 2] > 0.0 else "z",
        pixels=float(pixels.min()),
        is_small=bool(pixels.min() < CLEAR),
        width=camera.size[0],
        tilts=(float(tilts.min()), float(tilts.max())),
        seen=100.0 * float(view.shown.mean()),
        is_large=bool(2.0 * np.linalg.norm(_find_middle(camera)) > robot.size),
        squares=tuple(n + 1 for n in camera.corners),
        square=robot.to_quantity(camera.square, Dimension.LENGTH),
    )


def describe_stations(plan: Plan) -> Iterator[str]:
    """Yield a line on each station of a camera: where it is, how it sees the board at its poses."""
    cameras, coordinates = np.array(plan.poses.cameras), plan.poses.coordinates
    for kind in (sensor.kind for sensor in plan.instrument.sensors):
        if isinstance(kind, Image) and kind.mount == "board":
            own = coordinates[cameras == kind.camera] if len(cameras) else coordinates
            view = _watch(kind, inverse(plan.robot, own).T)
            yield f"{kind.camera}: {_describe(plan.robot, view)}"
