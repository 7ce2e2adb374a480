# SPDX-License-Identifier: Apache-2.0
"""The scores of a block: draw machines, measure and calibrate them, compare with the truth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.diagnose.error_frames import fit_frames
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.unfixed_motions import frame_twists
from loopcal.measure.instrument import BlockStream, make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import Trials, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import Status
from loopcal.studies.simulation.fits import (
    NOT_REACHED,
    FittedTrials,
    fit_trials,
    has_result,
    is_reached,
    solve_cell_poses,
    state_times,
)
from loopcal.studies.simulation.machines import (
    CellPoses,
    PreparedCell,
    compute_poses,
    describe_poses,
    draw_machines,
    hide_columns,
    make_disturbance,
    measure_held_points,
    prepare_cell,
    share_content,
)
from loopcal.studies.specification.study import (
    Study,
    compute_key,
    describe_cell,
    format_json,
    list_columns,
)
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

HELD_OUT = 4
"""Purpose of the random stream from which the errors of the readings of held-out poses come."""

PARTS = {"position": slice(3, 6), "orientation": slice(0, 3)}
"""Score -> its components of a twist."""


@dataclass(frozen=True)
class PosesTask:
    """Poses to draw or to plan. `content` : what determines them, as JSON. `key` : its hash."""

    key: str
    content: str


@dataclass(frozen=True)
class BlockTask:
    """A block to compute.

    key : hash of everything that determines its numbers. cell : number of its cell.
    block : number of the block in its cell. content : all that `compute_block` needs, as JSON.
    """

    key: str
    cell: int
    block: int
    content: str


def compute_block(task: BlockTask, threads: int = 1) -> FloatArray:
    """Simulate and calibrate the machines of a block, and return their scores (B, s), SI.

    Columns are `Study.columns`. Column 0 is the outcome: 0 for a trial that converged, else the
    number of a code in OUTCOMES. Other numbers of a failed trial are NaN where they do not exist.

    It is a pure function of `task.content`: the same numbers to the last bit in every process, for
    every number of threads and workers.

    Raises LoopcalError: the cell cannot be simulated at all, such as a kind that the robot does not
    have.
    """
    content = json.loads(task.content)
    cell, trials, fits = calibrate_block(content, threads)
    stream = make_stream(cell.content.seed, content["block"])
    names = [column.name for column in list_columns(cell.content.scores)]
    scores: dict[str, Any] = dict.fromkeys(names, np.nan)
    scores |= score_poses(cell, trials, fits, stream) | score_parameters(cell, trials, fits)
    scores |= fits.scores
    assert set(scores) == set(names), "a score needs its column in studies/specification/study.py"
    columns = np.broadcast_arrays(*(scores[name] for name in names))
    return np.stack(columns, axis=1)


def compute_task(task: BlockTask | PosesTask, threads: int = 1) -> FloatArray | CellPoses:
    """Compute a block, see `compute_block`, or poses."""
    if isinstance(task, PosesTask):
        return compute_poses(json.loads(task.content))
    return compute_block(task, threads)


def make_poses_task(content: Mapping[str, Any]) -> PosesTask:
    """Return the task of the poses of a block, from its description."""
    description = describe_poses(content)
    return PosesTask(compute_key(description), format_json(description))


def make_block_task(cell: int, content: Mapping[str, Any], poses: CellPoses) -> BlockTask:
    """Return the task of a block of a cell, from its description and its poses."""
    complete = format_json({**content, **vars(poses)})
    return BlockTask(compute_key(content), cell, content["block"], complete)


def list_tasks(
    study: Study, cells: Sequence[int] | None = None, blocks: Sequence[int] | None = None
) -> Iterator[BlockTask]:
    """Yield the tasks of these blocks of these cells, of all by default. The poses of a cell are
    drawn or planned here; the driver of a study leaves them to workers.
    """
    known = dict[str, CellPoses]()
    for number in range(len(study.cells)) if cells is None else cells:
        of_cell = describe_cell(study, study.cells[number])
        task = make_poses_task(of_cell)
        poses = known.get(task.key) or compute_poses(json.loads(task.content))
        known[task.key] = poses
        for block in range(study.blocks) if blocks is None else blocks:
            yield make_block_task(number, of_cell | {"block": block}, poses)


def calibrate_block(
    content: Mapping[str, Any], threads: int = 1
) -> tuple[PreparedCell, Trials, FittedTrials]:
    """Simulate and calibrate the machines of the content of a task, by so many threads."""
    cell, trials = prepare_cell(content), _simulate(format_json(share_content(content, "block")))
    return cell, trials, fit_trials(cell, trials, threads)


@lru_cache(maxsize=2)
def _simulate(text: str) -> Trials:
    """Return the machines of a block and their measurements, which are those of all methods; text :
    its `share_content`, as JSON.
    """
    content = json.loads(text)
    cell = prepare_cell(content)
    return simulate_block(cell, make_stream(cell.content.seed, content["block"]))


def make_stream(seed: int, block: int) -> BlockStream:
    """Return the random stream of a block.

    It depends on the seed of the study and the number of the block only. All cells see the same
    machines and the same noise as far as they have the same parameters, poses and columns, so that
    differences between cells are paired.
    """
    digest = hashlib.sha256(f"loopcal study {seed}".encode()).digest()
    return BlockStream(int.from_bytes(digest[:16], "little"), block)


def simulate_block(cell: PreparedCell, stream: BlockStream) -> Trials:
    """Draw the true machines of a block and measure them; with a verdict, also held-out poses."""
    poses = cell.measured
    if cell.content.scores.verdict:
        poses = np.concatenate([poses, np.array(cell.content.held_out)])
    truth = draw_machines(cell.robot, cell.content.errors, cell.content.trials, stream)
    if cell.layout is not None:
        return measure_held_points(cell.layout, truth, cell.instrument, stream)
    disturbance = make_disturbance(cell.robot, truth, poses, cell.content.effects, stream)
    trials = simulate_trials(
        cell.robot, truth, poses, cell.instrument, stream, disturbance=disturbance
    )
    return hide_columns(trials, cell.content.instrument.unused)


def score_poses(
    cell: PreparedCell, trials: Trials, fits: FittedTrials, stream: BlockStream
) -> dict[str, FloatArray]:
    """Return the outcome, the errors of held-out poses before and after calibration, and how many
    lie within their expanded uncertainty.
    """
    robot, held_out = cell.robot, cell.held_out
    readings, sigma = held_out.q[None], robot.stated_sigma  # true ones are those that are shown,
    if sigma.any():  # with errors where the robot states their standard deviation
        streams = (make_random_stream(stream, trial, HELD_OUT) for trial in range(len(trials)))
        drawn = np.stack([s.standard_normal(readings.shape[1:]) for s in streams])
        readings = readings + drawn * sigma
    truth = forward_trials(robot, trials.truth, readings, held_out.state)
    state, reference = fits.states or solve_cell_poses(cell, fits.values)
    is_lost = has_result(fits.outcome) & ~(is_reached(truth) & is_reached(state))
    is_known = np.all(np.isfinite(fits.values), axis=1)[:, None, None, None]
    nominal = held_out.T[None], cell.reference.T[None]
    fitted = (np.where(is_known, s.T, np.nan) for s in (state, reference))
    scores: dict[str, FloatArray] = {"outcome": np.where(is_lost, NOT_REACHED, fits.outcome)}
    for when, (T, measured) in {"_before": nominal, "": tuple(fitted)}.items():
        tools = np.broadcast_to(T, truth.T.shape) @ robot.tool
        error = geometry.pose_difference(tools, truth.T @ robot.tool)
        if not robot.can_rotate:
            error[..., :3] = np.nan
        if cell.content.scores.frame == "both":
            for name, part in PARTS.items():
                size = np.linalg.norm(error[..., part], axis=2)
                scores[f"{name}_base{when}"] = compute_rms(size)
        if cell.motions.shape[1]:
            error = error - _fit_motions(cell, trials, T, measured)
        for name, part in PARTS.items():
            size = np.linalg.norm(error[..., part], axis=2)
            scores[name + when] = compute_rms(size)
            scores[f"{name}{when}_max"] = size.max(axis=1)
            if not when:
                limit = fits.expanded[..., 0 if name == "position" else 1]
                scores[f"covered_{name}"] = compute_share(size, limit)
    return scores


def score_parameters(
    cell: PreparedCell, trials: Trials, fits: FittedTrials
) -> dict[str, FloatArray]:
    """Return the errors of the free parameters, and how many lie in their intervals."""
    free = select_free_parameters(cell.robot)
    error = (fits.values - trials.truth)[:, free.places]
    dimensions = [cell.robot.parameters.dimensions[i] for i in free.places]
    is_length = np.array([d is Dimension.LENGTH for d in dimensions])
    is_angle = np.array([d is Dimension.ANGLE for d in dimensions])
    scaled = error / free.tolerance
    return {
        "parameters": compute_rms(scaled),
        "parameters_max": np.abs(scaled).max(axis=1),
        "lengths": compute_rms(error[:, is_length]),
        "angles": compute_rms(error[:, is_angle]),
        "covered_parameters": compute_share(np.abs(error), fits.half_width),
    }


def compute_rms(values: FloatArray) -> FloatArray:
    """Return the root mean square (t,) of values (t, k); NaN of none."""
    if not values.shape[1]:
        return np.full(len(values), np.nan)
    return np.sqrt(np.mean(values**2, axis=1))


def compute_share(error: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the share (t,) of k errors up to their limits (t, k), which may be infinite; NaN where
    an error or a limit does not exist.
    """
    is_undefined = np.isnan(error).any(axis=1) | np.isnan(limit).any(axis=1)
    return np.where(is_undefined, np.nan, (error <= limit).mean(axis=1))


def _fit_motions(
    cell: PreparedCell, trials: Trials, T: FloatArray, measured: FloatArray
) -> FloatArray:
    """Return the errors (t, h, 6) of the tool at platform poses T (t | 1, h, 4, 4) that motions of
    frames explain: those that fit the errors of the measured poses (t | 1, n, 4, 4) best.
    """
    robot, n = cell.robot, len(cell.measured)
    true, usable = trials.T[:, :n], trials.reached[:, :n]
    if cell.layout is not None:  # the poses at the readings of the nominal robot
        state = forward_trials(robot, trials.truth, cell.reference.q[None], cell.reference.state)
        true, usable = state.T, state.status == Status.CONVERGED
    poses, places = (np.broadcast_to(a, (len(true), *a.shape[1:])) for a in (measured, T))
    errors = geometry.pose_difference(poses, true)
    explained = []
    for i, used in enumerate(usable & np.isfinite(poses).all(axis=(2, 3))):
        if not used.any():  # a trial without a calibrated machine
            explained.append(np.full((places.shape[1], 6), np.nan))
            continue
        motion = fit_frames(robot, poses[i, used], cell.motions)(errors[i, used][..., None])
        arm = places[i, :, :3, :3] @ robot.tool[:3, 3]
        twists = frame_twists(places[i], robot.size) @ motion
        explained.append((geometry.transport_matrix(arm) @ twists)[..., 0])
    return np.stack(explained)


@dataclass(frozen=True, eq=False)
class CalibratedCell:
    """t calibrated machines, which are not scored.

    levels : factor -> level. robot : nominal. readings : (n, a) [SI] of the controller.
    truth, values : (t, p) [SI] true and estimated parameters; values are NaN where there are none.
    measured : of each sensor (t, r, c) [SI]. outcome : (t,) numbers of OUTCOMES before held-out
        poses are looked at. iterations : (t,).
    """

    levels: Mapping[str, str]
    robot: Mechanism
    readings: FloatArray
    truth: FloatArray
    values: FloatArray
    measured: tuple[FloatArray, ...]
    outcome: IntArray
    iterations: IntArray

    @property
    def is_converged(self) -> BoolArray:
        """(t,) which fits converged."""
        return self.outcome == 0


def calibrate_cells(study: Study, cells: Sequence[int] | None = None) -> Iterator[CalibratedCell]:
    """Yield the calibrations of these cells, of all by default, one cell after the other."""
    if not study.scores.verdict:  # held-out poses are not looked at
        study = replace(study, scores=replace(study.scores, held_out=1, frame="base"))
    for number, tasks in groupby(list_tasks(study, cells), lambda task: task.cell):
        blocks = [calibrate_block(json.loads(task.content)) for task in tasks]
        prepared, trials, fits = zip(*blocks, strict=True)

        def join(arrays: Iterable[np.ndarray]) -> np.ndarray:
            return np.concatenate(list(arrays))[: study.replicates]

        iterations = join(f.scores.get("iterations", 0 * f.outcome) for f in fits)
        yield CalibratedCell(
            study.cells[number].levels,
            prepared[0].robot,
            trials[0].readings,
            join(t.truth for t in trials),
            join(f.values for f in fits),
            tuple(join(measured) for measured in zip(*(t.measured for t in trials), strict=True)),
            join(f.outcome for f in fits),
            np.nan_to_num(iterations).astype(np.int64),
        )


def find_cells(study: Study, **levels: str) -> tuple[int, ...]:
    """Return the numbers of the cells with these levels, factor=level."""
    return tuple(
        cell.number
        for cell in study.cells
        if all(cell.levels[factor] == level for factor, level in levels.items())
    )


def set_size(study: Study, seed: int, trials: int) -> Study:
    """Return a study with another seed and so many trials in each cell; machine i of its first
    block is the same for any number of trials.
    """
    return replace(study, seed=seed, replicates=trials, block=min(trials, study.block))


def replay_trial(
    study: Study, cell: int, trial: int
) -> tuple[PreparedCell, Mechanism, Measurements]:
    """Return the cell, the true machine and the measurements of a trial, to the last bit; trials of
    a cell are numbered from 0, over all of its blocks.

    Raises DataError: the study has no such cell or trial.
    """
    for name, number, count in (
        ("cell", cell, len(study.cells)),
        ("trial", trial, study.blocks * study.block),
    ):
        if not 0 <= number < count:
            raise DataError(
                f"this study has no {name} {number}; its {name}s are numbered from 0 to {count - 1}"
            )
    block, place = divmod(trial, study.block)
    (task,) = list_tasks(study, [cell], blocks=[block])
    content = json.loads(task.content)
    prepared = prepare_cell(content)
    trials = simulate_block(prepared, make_stream(prepared.content.seed, block))
    data = state_times(trials.trial(place))
    if prepared.content.scores.verdict:
        data = prepared.hold_out(data)
    return prepared, prepared.robot.with_values(trials.truth[place]), data
