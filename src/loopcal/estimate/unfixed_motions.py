# SPDX-License-Identifier: Apache-2.0
"""Motions of the base and platform frames that measurements do not determine.

Let M (6, 12) be the twist of a pose by a motion g of the two frames, J the derivative of a measured
row by that twist, and F that by the setup parameters (frames, targets, surfaces, offsets). A motion
g that solves `J M g + F b = 0` for all rows, with any b, changes no measured value. The solutions
are the null space of what is left of J M once F is eliminated. A setup parameter with a stated
tolerance adds its row; tolerances of the machine do not. See docs/theory/observability.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np

from loopcal import engine, geometry
from loopcal.estimate.elimination import (
    EliminatedNuisance,
    divide_among_nodes,
    fold_node_rows,
    list_members,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Linearization, LinearizedPoses, Start, linearize_rows
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.posterior import SAME_MOTION, FrameKnowledge, InstrumentFrame
from loopcal.estimate.prior import Prior
from loopcal.estimate.problem import Problem
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Evaluation
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.numerics.decomposition import empty_factor, intersect_spaces
from loopcal.numerics.elimination import NodeFactors
from loopcal.numerics.statistics import choose_evenly, find_distinct
from loopcal.typing import FloatArray, IntArray

MOTIONS = 12
"""Numbers of a motion of both frames: (w, c) of the base, then (w, c) of the platform."""

UNFIXED = 1e-8
"""Share of the largest effect on the measured rows up to which a motion of a frame has none: the
square root of double rounding.
"""

FIXED = 1e-4
"""Share of the largest effect above which a motion stays fixed, whatever rows follow: these would
have to be ten thousand times as accurate as all before them."""

MOST_READINGS = 200
"""Largest number of measured poses that are kept with a fit."""


def frame_twists(T: FloatArray, size: float) -> FloatArray:
    """Return the twists (.., 6, 12) of poses T (.., 4, 4) by motions of the two frames [m].

    Rotations of the frames are multiplied by the robot's `size`, so that all twelve numbers are
    lengths; see `geometry.differentiate_by_frames`.
    """
    unit = np.array([1.0 / size] * 3 + [1.0] * 3)
    return geometry.differentiate_by_frames(T) * np.r_[unit, unit]


class UnfixedMotions(NamedTuple):
    """Motions (12, k) of frames that change no measured value, orthonormal, and the derivative (U,
    12) by which the setup parameters follow any motion; None without setup parameters.
    """

    motions: FloatArray
    followed: FloatArray | None


class FrameRows:
    """The rows of one machine by motions of frames, collected block by block.

    problem : of one machine. nuisance : (1, U) values of the setup parameters; None without any.
    """

    def __init__(self, problem: Problem, nuisance: FloatArray | None) -> None:
        self._problem, self._nuisance, self._effect = problem, nuisance, 0.0
        tree = None if problem.nuisance is None else problem.nuisance.tree
        self._factor = empty_factor(1, MOTIONS)
        self._factors = None if tree is None else NodeFactors(tree, 1, MOTIONS)
        self._is_lost = self._is_fixed = False

    def add(
        self, number: int, poses: LinearizedPoses, evaluations: Sequence[Evaluation | None]
    ) -> None:
        """Add the rows of a block, at its poses and evaluated there; see `Problem.residuals`."""
        block = self._problem.poses.blocks[number]
        self._is_lost |= bool(poses.is_lost(block.is_needed)[0])
        if self._is_fixed:
            return
        self.add_rows(block.rows, poses.T, poses.joints, evaluations)
        if self._factors is None and len(self._problem.poses.blocks) > 1:
            s = np.linalg.svd(self._factor[0, :MOTIONS, :MOTIONS], compute_uv=False)
            self._is_fixed = bool(s[-1] > FIXED * self._effect)

    def add_rows(
        self,
        kinds: Sequence[ObservationRows],
        T: FloatArray,
        joints: Mapping[str, FloatArray],
        evaluations: Sequence[Evaluation | None],
    ) -> None:
        """Add the rows of every kind at poses T (1, n, 4, 4) and joints name -> (1, n)."""
        elimination, whitened, trial = self._problem.nuisance, [], np.zeros(1, dtype=np.int64)
        by_frames = frame_twists(T, self._problem.free.robot.size)
        poses = LinearizedPoses(T, np.ones(T.shape[:2], dtype=bool), by_frames, joints)
        tree = None if elimination is None else elimination.tree
        observed = [pair for pair in zip(kinds, evaluations, strict=True) if len(pair[0].poses)]
        for rows, evaluated in observed:
            kind = linearize_rows(rows, poses, trial, self._nuisance, evaluated=evaluated)
            length = float(np.linalg.norm(kind.by_parameters))
            self._effect = float(np.hypot(self._effect, length))
            whitened.append(kind)
        members = [list_members(elimination, rows) for rows, _ in observed]
        node_rows = divide_among_nodes(whitened, members, tree)
        self._factor = fold_node_rows(self._factor, self._factors, node_rows)

    def find_unfixed(self) -> UnfixedMotions | None:
        """Return the motions of frames that change no measured value; None where a pose that a row
        needs was not reached.
        """
        if self._is_lost:
            return None
        factor, elimination = self._factor, self._problem.nuisance
        by_setup = None
        if elimination is not None and self._factors is not None and self._nuisance is not None:
            eliminated, rest = elimination.eliminate(self._factors, self._nuisance)
            factor, by_setup = engine.fold(factor, rest), eliminated.elimination.slope[0]
        return UnfixedMotions(unfixed_motions(factor, self._effect), by_setup)


def unfixed_motions(factor: FloatArray, effect: float) -> FloatArray:
    """Return the null space (12, k) of a triangular factor (1, 13, 13) of rows by frame motions.

    `effect` is the length of these rows before setup parameters were eliminated, of which
    UNFIXED or less is rounding.
    """
    _, s, vt = np.linalg.svd(factor[0, :MOTIONS, :MOTIONS])
    return vt[s <= UNFIXED * effect].T


def find_frame_knowledge(
    problem: Problem,
    data: Measurements,
    deviation: FloatArray,
    start: Start,
    prior: Prior | None = None,
    linearization: Linearization | None = None,
    noise: float = 1.0,
) -> FrameKnowledge:
    """Return how the measurements of one machine determine frames, at deviation (1, p); see
    `describe_frames`.
    """
    found, located = None, problem.poses.locate(deviation, start)
    if located is not None:
        rows = FrameRows(problem, None if problem.nuisance is None else start.nuisance)
        divided = problem.rows if problem.is_uncertain else [r.divided() for r in problem.rows]
        rows.add_rows(divided, located[0][None], located[1], [None] * len(divided))
        found = rows.find_unfixed()
    return describe_frames(problem, data, found, prior, linearization, noise)


def describe_frames(
    problem: Problem,
    data: Measurements,
    found: UnfixedMotions | None,
    prior: Prior | None = None,
    linearization: Linearization | None = None,
    noise: float = 1.0,
) -> FrameKnowledge:
    """Return how the measurements of one machine determine frames, with motions from
    `FrameRows.find_unfixed`.

    An earlier calibration may determine frames that these measurements do not. Without a
    linearization, or a finite noise variance, the unknown frames of instruments are not described.
    """
    readings = data.readings[choose_evenly(len(data.readings), MOST_READINGS)]
    readings = readings[np.isfinite(readings).all(axis=1)]
    if found is None:
        return FrameKnowledge(np.zeros((MOTIONS, 0)), readings)
    unfixed = found.motions
    if prior is not None and prior.unfixed is not None:
        unfixed = intersect_spaces(unfixed, prior.unfixed, SAME_MOTION)
    is_known = np.isfinite(noise)  # not that of a fit that did not converge
    eliminated = None if linearization is None or not is_known else linearization.nuisance
    local = None if problem.nuisance is None else problem.nuisance.local
    frames = _describe_instruments(problem.free, data, local, eliminated, noise, found.followed)
    if np.linalg.norm(unfixed[:6]) > UNFIXED:
        # a stated frame is that of the base, which something else leaves open, such as an anchor
        frames = {name: frame for name, frame in frames.items() if frame.own.any()}
    return FrameKnowledge(unfixed, readings, frames)


def _describe_instruments(
    free: FreeParameters,
    data: Measurements,
    local: NuisanceParameters | None,
    eliminated: EliminatedNuisance | None,
    noise: float,
    followed: FloatArray | None,
) -> dict[str, InstrumentFrame]:
    """Return the frames in which the kinds of measurements measure.

    A frame of unbounded uncertainty, as after a fit that did not converge, is left out.
    """
    frames: dict[str, InstrumentFrame] = {}
    for name, stated, is_unknown in list_instrument_frames(data):
        if not is_unknown:
            nothing = np.zeros((6, len(free)))
            frames[name] = InstrumentFrame(stated, nothing, np.zeros((6, 6)))
        elif local is not None and eliminated is not None:
            axes = (*setup.ROTATION_AXES, *setup.POSITION_AXES)
            places = np.array([local.table.index(f"{name}.{axis}") for axis in axes])
            frame = _describe_unknown(stated, places, eliminated, free, noise, followed)
            if np.isfinite(frame.own).all() and np.isfinite(frame.by_parameters).all():
                frames[name] = frame
    return frames


def list_instrument_frames(data: Measurements) -> Iterable[tuple[str, FloatArray, bool]]:
    """Return name, stated T_base_frame (4, 4) and whether it is unknown of each complete frame."""
    listed: dict[str, tuple[FloatArray, bool]] = {}
    for rows in data.all_observations:
        name, stated = getattr(rows.kind, "frame", None), getattr(rows.kind, "T_base_frame", None)
        if name is None or stated is None or "frame" not in rows.kind.allowed_unknown:
            continue
        if len(rows.kind.possible_setup["frame"].parameters) != 6:
            continue
        is_unknown = "frame" in rows.kind.unknown
        for session in find_distinct(rows.session).tolist():
            full = f"{session}.{name}" if session else name
            listed[full] = (cast(FloatArray, stated), is_unknown)
    return [(name, *fields) for name, fields in listed.items()]


def _describe_unknown(
    stated: FloatArray,
    places: IntArray,
    eliminated: EliminatedNuisance,
    free: FreeParameters,
    noise: float,
    followed: FloatArray | None,
) -> InstrumentFrame:
    """Return a frame whose six parameters have these places among the setup parameters."""
    values = eliminated.best[0, places]
    L = setup.linearize_frame(values)
    elimination = eliminated.elimination
    nodes = elimination.tree.node[places]
    own = np.zeros((6, 6))
    if (nodes >= 0).any():
        node = np.array([int(nodes.max())])
        path, root, _ = elimination.at_nodes(node)
        rows = np.zeros((6, root.shape[-1]))
        for i, place in enumerate(places):
            match = np.flatnonzero(path[0] == place)
            if len(match):
                rows[i] = root[0, match[0]]
        triangle = np.asarray(np.linalg.qr(rows.T, mode="r"))
        own[:, : len(triangle)] = triangle.T
    slope = elimination.slope[0, places] / free.tolerance
    T = setup.place_frame(stated, values)
    by_motions = None if followed is None else L @ followed[places]
    return InstrumentFrame(T, L @ slope, np.sqrt(noise) * (L @ own), by_motions)
