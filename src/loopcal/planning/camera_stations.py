# SPDX-License-Identifier: Apache-2.0
"""Where a camera stands that looks at a printed board on the platform.

A station lies in a direction from the middle of the places that the board visits, and so far away
that the picture shows all of these places. The board faces one side of the platform or the other.
The chosen station has the smallest error that is predicted of the tool over the workspace.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, EstimationError
from loopcal.findings import Finding, report_finding
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.image import PRINT_SD, Image, state_camera
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution
from loopcal.planning.candidates import draw_candidates
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.problem import prepare_problem
from loopcal.typing import FloatArray, Progress, report_no_progress
from loopcal.units import Dimension

TILTS = np.radians([10.0, 25.0, 40.0, 55.0])  # between line of sight and normal of the board
AROUND = np.radians(np.arange(0.0, 360.0, 45.0))  # directions about the normal
FILLED = 0.92  # share of a picture that the places of the board fill
DRAWN = 60  # poses by which stations are compared
CLEAR = 30.0  # width of a square in a picture [px], where it is narrow, whose marker is found
ALIKE = 0.02  # share by which a station may be worse than the best, if it comes before it
SIGMA = 0.1  # standard deviation of a corner in a picture [px]


def list_stations(robot: Mechanism, camera: Image, poses: Solution) -> Iterator[Image]:
    """Yield placements of a fixed camera and of a board on the platform that moves to poses."""
    width, height = camera.square * (np.array(camera.corners) - 1)
    middle = np.array([0.5 * width, 0.5 * height, 0.0])
    tools = (poses.T @ robot.tool)[:, :3, 3]
    center = 0.5 * (tools.min(axis=0) + tools.max(axis=0))
    reach = np.linalg.norm(tools - center, axis=1).max() + np.linalg.norm(middle)
    slope = 0.5 * FILLED * min(camera.size) / camera.nominal_lens[:2].max()
    distance = reach * (1.0 + 1.0 / slope)
    step = 10.0 ** np.floor(np.log10(distance / 20.0))  # to which a person places a camera
    home = robot.home[:3, :3]
    for side in (1.0, -1.0):  # where the board faces along the z axis of the platform
        R = np.diag([1.0, -side, -side])  # the z axis of a board leads away from who reads it
        board = geometry.make_pose(R, robot.tool[:3, 3] - R @ middle)
        for tilt in TILTS:
            for angle in AROUND:
                across = np.array([np.cos(angle), np.sin(angle)]) * np.sin(tilt)
                station = center + distance * home @ np.append(across, side * np.cos(tilt))
                station = np.round(station / step) * step + 0.0
                yield replace(camera, T_camera=look_at(station, center), T_board=board)


def look_at(station: FloatArray, place: FloatArray) -> FloatArray:
    """Return the pose of a camera at a station whose line of sight meets a place, held level."""
    sight = (place - station) / np.linalg.norm(place - station)
    right = np.cross(sight, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    return geometry.make_pose(np.column_stack([right, np.cross(sight, right), sight]), station)


def choose_station(
    robot: Mechanism,
    camera: Image,
    options: PlanOptions | None = None,
    scales: Sequence[tuple[float, float]] = ((0.0, PRINT_SD),) * 2,
    progress: Progress = report_no_progress,
) -> tuple[Instrument, Finding]:
    """Return the instrument with the camera at the best station, and where that is.

    camera : its lens and the board. scales : of the print, see `state_camera`.
    options : their line of sight fixes the station.

    DataError : the camera is on the platform, or no station promises a bounded error.
    """
    options = options or PlanOptions()
    camera, stated = state_camera(camera, scales)
    candidates = draw_candidates(robot, options.constraints, DRAWN, options.seed)
    stations = _list_allowed(robot, camera, candidates.solution, options)
    errors = np.full(len(stations), np.inf)
    noise, every = Gaussian([SIGMA, SIGMA]), np.arange(len(candidates))
    for i, at in enumerate(stations):
        placed = Instrument((Sensor(at, noise),), stated)
        with_few = replace(options, allow_fewer_equations=True)
        try:
            found = prepare_problem(robot, placed, with_few, candidates).predict_errors(every)
        except EstimationError:  # it sees no board, or leaves a frame open without tolerances
            found = None
        errors[i] = np.inf if found is None else found.select(options.target)
        progress(i + 1, len(stations), "stations of the camera")
    if not np.isfinite(errors).any():
        raise DataError(report_finding("plan.no-station", robot=robot.name))
    best = stations[int(np.flatnonzero(errors <= (1.0 + ALIKE) * errors.min())[0])]
    return Instrument((Sensor(best, noise),), stated), _describe(robot, best, candidates.solution)


def _list_allowed(
    robot: Mechanism, camera: Image, poses: Solution, options: PlanOptions
) -> list[Image]:
    """Return the stations whose pictures are clear, if there are any, or those two at the place
    that the line of sight states.
    """
    stations, sight = list(list_stations(robot, camera, poses)), options.constraints.sight
    if camera.mount != "board":
        raise DataError(report_finding("plan.camera-mounted", robot=robot.name))
    if sight is None:
        clear = [_watch(at, poses)[2].min() >= CLEAR for at in stations]
        return [
            at for at, is_clear in zip(stations, clear, strict=True) if is_clear or not any(clear)
        ]
    center = (poses.T @ robot.tool)[:, :3, 3].mean(axis=0)
    sides = stations[0], stations[-1]
    return [replace(at, T_camera=look_at(sight.station, center)) for at in sides]


def _watch(camera: Image, poses: Solution) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return at each pose the distance of the board [m], the angle [deg] between its normal and the
    line of sight, and the width [px] of its squares where they look narrowest.
    """
    T = poses.T @ camera.T_board
    width, height = camera.square * (np.array(camera.corners) - 1)
    sight = (T @ [0.5 * width, 0.5 * height, 0.0, 1.0])[:, :3] - camera.T_camera[:3, 3]
    distance = np.linalg.norm(sight, axis=1)
    cosine = np.clip((T[:, :3, 2] * sight).sum(axis=1) / distance, -1.0, 1.0)
    pixels = camera.square * camera.nominal_lens[0] / distance
    return distance, np.degrees(np.arccos(cosine)), pixels * cosine


def _describe(robot: Mechanism, camera: Image, poses: Solution) -> Finding:
    """Return where the camera stands, and how it sees the board."""
    distance, tilts, pixels = _watch(camera, poses)
    each = np.repeat(poses.T, camera.rows_per_pose, axis=0)[None]
    columns = camera.measure(each, np.zeros((1, each.shape[1], 2)))
    seen = camera.hide_unseen(each, columns, camera.nominal_values[None, None])
    return report_finding(
        "plan.camera-station",
        place=tuple(robot.to_quantity(float(x), Dimension.LENGTH) for x in camera.T_camera[:3, 3]),
        distance=robot.to_quantity(float(np.median(distance)), Dimension.LENGTH),
        side="-z" if camera.T_board[2, 2] > 0.0 else "z",
        pixels=float(pixels.min()),
        is_small=bool(pixels.min() < CLEAR),
        width=camera.size[0],
        tilts=(float(tilts.min()), float(tilts.max())),
        seen=100.0 * float(camera.detect_present(seen).mean()),
        squares=tuple(n + 1 for n in camera.corners),
        square=robot.to_quantity(camera.square, Dimension.LENGTH),
    )
