# SPDX-License-Identifier: Apache-2.0
"""Information that measurements hold of a robot at its present values, and the motions of the base
and platform frames that they do not determine.

Rows are [F | A | r]: nuisance parameters, the robot's free parameters in spreads, the residual,
all whitened. Identifiability is read from the triangular factor of what is left of A once F is
eliminated: the projection onto the complement of F, without forming it. See
docs/theory/identification.md.

Let M (6, 12) be the twist of a pose by a motion g of the two frames, J the derivative of a measured
row by that twist, and F that by the setup parameters (frames, targets, surfaces, offsets). A motion
g that solves `J M g + F b = 0` for all rows, with any b, changes no measured value. The solutions
are the null space of what is left of J M once F is eliminated. A setup parameter with a stated
spread adds its row; tolerances of the machine do not. See docs/theory/observability.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np

from loopcal import engine, geometry
from loopcal.estimate.elimination import (
    EliminatedNuisance,
    divide_among_nodes,
    fold_node_rows,
    list_members,
)
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.linearization import (
    Linearization,
    LinearizedPoses,
    Start,
    linearize_poses,
    linearize_rows,
)
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.penalties import Method, decompose_for
from loopcal.estimate.posterior import SAME_MOTION, FrameKnowledge, InstrumentFrame
from loopcal.estimate.prior import Prior
from loopcal.estimate.problem import Problem, problem_of
from loopcal.measure.initial_values import evaluate_measurements, whiten_rows
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Evaluation
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.readings import resolve_reading_sigma
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import RANK_TOLERANCE, empty_factor, intersect_spaces
from loopcal.numerics.elimination import NodeFactors, eliminate_from_factor
from loopcal.numerics.statistics import choose_evenly, find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray

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
        observed = [pair for pair in zip(kinds, evaluations, strict=True) if len(pair[0].poses)]
        for rows, evaluated in observed:
            kind = linearize_rows(rows, poses, trial, self._nuisance, evaluated=evaluated)
            length = float(np.linalg.norm(kind.by_parameters))
            self._effect = float(np.hypot(self._effect, length))
            whitened.append(kind)
        members = [list_members(elimination, rows) for rows, _ in observed]
        node_rows = divide_among_nodes(whitened, members)
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


def find_unfixed_motions(
    problem: Problem, deviation: FloatArray, start: Start
) -> UnfixedMotions | None:
    """Return the result of `FrameRows` at deviation (1, p) of one machine."""
    if (located := problem.poses.locate(deviation, start)) is None:
        return None
    rows = FrameRows(problem, None if problem.nuisance is None else start.nuisance)
    divided = problem.rows if problem.is_uncertain else [r.divided() for r in problem.rows]
    rows.add_rows(divided, located[0][None], located[1], [None] * len(divided))
    return rows.find_unfixed()


def describe_frames(
    problem: Problem,
    data: Measurements,
    found: UnfixedMotions | None,
    prior: Prior | None = None,
    linearization: Linearization | None = None,
    noise: float = 1.0,
) -> FrameKnowledge:
    """Return how the measurements of one machine determine frames, with motions from
    `find_unfixed_motions`.

    An earlier calibration may determine frames that these measurements do not. Without a
    linearization, or a finite noise variance, the unknown frames of instruments are not described;
    nor is a frame of unbounded uncertainty, as after a fit that did not converge.
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
    free, frames = problem.free, dict[str, InstrumentFrame]()
    axes = (*setup.ROTATION_AXES, *setup.POSITION_AXES)
    for name, stated, is_unknown in list_instrument_frames(data):
        if not is_unknown:
            nothing = np.zeros((6, len(free)))
            frames[name] = InstrumentFrame(stated, nothing, np.zeros((6, 6)))
        elif problem.nuisance is not None and eliminated is not None:
            table = problem.nuisance.local.table
            places = np.array([table.index(f"{name}.{axis}") for axis in axes])
            frame = _describe_unknown(stated, places, eliminated, free, noise, found.followed)
            if np.isfinite(frame.own).all() and np.isfinite(frame.by_parameters).all():
                frames[name] = frame
    if np.linalg.norm(unfixed[:6]) > UNFIXED:
        # a stated frame is that of the base, which something else leaves open, such as an anchor
        frames = {name: frame for name, frame in frames.items() if frame.own.any()}
    return FrameKnowledge(unfixed, readings, frames)


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


@dataclass(frozen=True, eq=False)
class ObservedPoses:
    """Poses of a robot, solved and linearized once, that any kind may observe.

    free : the free parameters. readings : (n, actuators) [SI]. linearized : (1, n) poses.
    """

    free: FreeParameters
    readings: FloatArray
    linearized: LinearizedPoses

    @property
    def T(self) -> FloatArray:
        """(1, n, 4, 4) T_base_platform [m]."""
        return self.linearized.T

    @property
    def twists(self) -> FloatArray:
        """(1, n, 6, p) by deviations in spreads."""
        return self.linearized.by_parameters

    @property
    def joints(self) -> Mapping[str, FloatArray]:
        """name -> (1, n) values [SI] of the joints that were asked for."""
        return self.linearized.joints

    def by_frames(self) -> ObservedPoses:
        """Return the poses with derivatives by motions of the base and platform frames, see
        `frame_twists`, in place of the parameters.
        """
        by_frames = frame_twists(self.T, self.free.robot.size)
        moved = replace(self.linearized, by_parameters=by_frames, joints_by_parameters={})
        return replace(self, linearized=moved)

    @property
    def is_reached(self) -> BoolArray:
        """(n,) poses at which the loops close."""
        return self.linearized.is_reached[0]


def observe_poses(
    free: FreeParameters, readings: FloatArray, joints: Iterable[str] = ()
) -> ObservedPoses:
    """Solve and linearize a robot at readings (n, actuators) and its present values.

    `joints` are names of joints whose values and derivatives are needed.
    """
    values = free.robot.values[None]
    state = forward_trials(free.robot, values, readings[None])
    poses = linearize_poses(free, values, readings[None], state, tuple(joints))
    return ObservedPoses(free, readings, poses)


def observe_rows(
    poses: ObservedPoses, measured: Measurements, nuisance: NuisanceParameters, values: FloatArray
) -> FloatArray:
    """Return whitened rows (1, M, U + p + 1), [nuisance | machine | residual], of measurements.

    `values` (U,) are those of the nuisance parameters `nuisance`. The columns of the machine are
    those of `poses.linearized`.
    """
    linearized = poses.linearized
    evaluated = evaluate_measurements(
        measured, linearized.T, values[None], nuisance, linearized.joints
    )
    rows = whiten_rows(evaluated, linearized.by_parameters, linearized.joints_by_parameters)
    p, u = linearized.by_parameters.shape[-1], len(nuisance)
    return np.concatenate([rows[..., p : p + u], rows[..., :p], rows[..., p + u :]], axis=-1)


def collect_information(free: FreeParameters, data: Measurements) -> tuple[FloatArray, BoolArray]:
    """Return the factor (1, p + 1, p + 1) of all rows [A | r] of measurements at the robot's
    present values, nuisance parameters eliminated, and the poses (n,) that close or that no row
    needs. Nuisance parameters and uncertain poses are where the measurements put them.
    """
    problem = problem_of(free, data)
    z = free.deviation(free.robot.values[None])
    start = problem.start(z)
    linearization = problem.linearize(z, start)
    is_reached = np.ones(data.n_poses, dtype=bool)
    if not np.isfinite(linearization.cost[0]):
        is_reached[problem.poses.find_unreached(z, start)] = False
    return linearization.factor, is_reached


def count_equations(robot: Mechanism, data: Measurements) -> int:
    """Return how many equations measurements give.

    They are the present residuals and, where readings are uncertain, less those that poses take up.
    """
    if resolve_reading_sigma(robot, data.reading_sigma, data.n_poses) is None:
        return data.n_rows
    return int(problem_of(select_free_parameters(robot), data).equations[0])


def has_equations_to_spare(
    problem: Problem, z: FloatArray, method: Method, tolerance: float = RANK_TOLERANCE
) -> bool:
    """Return whether the equations (t = 1) that setup parameters leave determine, at deviations z
    (1, p), all parameters without a penalty, or are more than the directions that they determine.

    Otherwise their number limits the rank. Poses out of reach count as spared: a fit names them.
    """
    rows = problem.linearize(z, problem.start(z))
    if not np.isfinite(rows.cost[0]):
        return True
    d = decompose_for(method, rows.factor, rows.equations, z, tolerance)
    required = method.required_equations(problem.parameters)
    determined = d.used if d.unpenalized is None else d.used & d.unpenalized
    rank = min(int(determined.sum()), required)
    return int(rows.equations[0]) > rank or rank == required > 0


def instrument_factor(poses: ObservedPoses, measured: Measurements) -> FloatArray:
    """Return the factor (1, p + 1, p + 1) of one instrument's rows at observed poses.

    Its nuisance parameters are eliminated at their stated values.
    """
    nuisance = measured.nuisance_parameters
    rows = observe_rows(poses, measured, nuisance, nuisance.values())
    factor = engine.fold(empty_factor(1, len(nuisance) + len(poses.free)), rows)
    has_prior = nuisance.table.free & ~np.isnan(nuisance.table.tolerance)
    weight = np.where(has_prior, 1.0 / np.where(has_prior, nuisance.table.tolerance, 1.0), 0.0)
    nothing = np.zeros((len(nuisance), len(poses.free) + 1))
    prior_rows = np.concatenate([np.diag(weight), nothing], axis=1)[None]
    return eliminate_from_factor(engine.fold(factor, prior_rows), len(nuisance))
