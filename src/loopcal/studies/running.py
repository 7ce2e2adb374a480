# SPDX-License-Identifier: Apache-2.0
"""Run a study: what `loopcal study run` does. A driver gives blocks to workers and stores what
they return; a single trial is calibrated again with all checks.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.calibration_report import CalibrationReport
from loopcal.estimate.identification import check_threads
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import name_count
from loopcal.io.core.outputs import FolderKind, refuse_folder, write_result_folder
from loopcal.io.core.text_file import as_path
from loopcal.io.data.measurement_file import format_measurements
from loopcal.io.robot.robot_file import format_robot
from loopcal.io.runs.run_folder import RUN, build_document, save_run
from loopcal.results.tables import Block
from loopcal.studies.executors import MOST_LOSSES, Executor, Processes, Serial, compute_timed
from loopcal.studies.files.store import StudySource, StudyStore, open_study, read_study
from loopcal.studies.files.study_file import load_study
from loopcal.studies.simulation.block import (
    OUTCOMES,
    BlockTask,
    PosesTask,
    compute_block,
    compute_plan,
    compute_task,
    fit_per_leg,
    make_block_task,
    make_poses_task,
    replay_trial,
)
from loopcal.studies.simulation.machines import CellPoses, is_planned
from loopcal.studies.specification import FACTORS, PER_LEG, Cell, Study, compute_key, describe_cell
from loopcal.studies.study_result import StudyResult, explain_failures
from loopcal.typing import Progress, report_no_progress

MOST_WAITING = 64  # cells whose poses are asked for while the first of them waits for its own


MOST_NAMED = 5  # blocks that were given up and are named in a finding
# Blocks whose keys are read at once, so that memory does not grow with the number of blocks.
LISTED = 200


@dataclass(frozen=True)
class Share:
    """One of several equal parts of the blocks of a study, for jobs that run at once.

    A study with at least as many cells as jobs is divided by cells, others by the blocks of each
    cell.

    part : from 1. of : their number.
    """

    part: int = 1
    of: int = 1

    def select_cells(self, study: Study) -> Sequence[Cell]:
        """Return the cells of this part."""
        return study.cells[self.part - 1 :: self.of] if self._by_cells(study) else study.cells

    def select_blocks(self, study: Study) -> range:
        """Return the blocks of this part in each of its cells."""
        step = 1 if self._by_cells(study) else self.of
        return range(0 if step == 1 else self.part - 1, study.blocks, step)

    def _by_cells(self, study: Study) -> bool:
        return len(study.cells) >= self.of


@dataclass(frozen=True)
class RunReport:
    """What a driver did.

    total : blocks that were asked for. before : of these, stored when it began. computed, trials :
        stored by it. given_up : blocks that stopped every worker, and cells whose poses did.
    losses : workers that were lost, as far as is known. worker_seconds : sum over all workers.
    damaged : stored blocks that were removed and computed again.
    """

    total: int
    before: int
    computed: int
    trials: int
    given_up: tuple[str, ...]
    losses: int
    seconds: float
    worker_seconds: float
    damaged: tuple[str, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Return whether all blocks are stored."""
        return self.before + self.computed == self.total

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What happened to workers and to stored blocks."""
        findings = []
        if self.damaged:
            named, count = self.damaged[:MOST_NAMED], len(self.damaged)
            findings.append(report_finding("store.blocks-removed", count=count, blocks=named))
        if self.losses:
            findings.append(report_finding("workers.lost", losses=self.losses))
        if self.given_up:
            named = self.given_up[:MOST_NAMED]
            code, count = "workers.blocks-given-up", len(self.given_up)
            findings.append(report_finding(code, count=count, losses=MOST_LOSSES, blocks=named))
        return tuple(findings)


WHOLE = Share()  # all blocks


def run_blocks(
    study: Study,
    store: StudyStore,
    executor: Executor,
    share: Share = WHOLE,
    progress: Progress = report_no_progress,
    threads: int = 1,
) -> RunReport:
    """Compute and store the blocks of a study that are missing in its store, each as soon as it is
    there; `threads` compute a block, in each worker.

    Damaged blocks are removed and computed again.

    Raises FileError: a block cannot be stored. StudyError, LoopcalError: see `Executor.map_blocks`
    and `compute_block`.
    """
    begin, damaged = time.perf_counter(), store.remove_damaged()
    total, before = count_blocks(study, share), count_stored(study, store, share)
    computed = trials = losses = 0
    seconds, given_up, poses = 0.0, list[str](), dict[str, CellPoses | None]()
    progress(before, total, "computing blocks")
    tasks = list_missing_tasks(study, store, poses, given_up, share)
    compute = compute_task if threads == 1 else partial(compute_task, threads=threads)
    with closing(executor.map_blocks(compute, tasks)) as answers:
        for answer in answers:
            task, result = answer.task, answer.result
            losses, seconds = losses + answer.losses, seconds + answer.seconds
            if isinstance(task, PosesTask):
                assert not isinstance(result, np.ndarray)
                poses[task.key] = result
            elif result is None:
                given_up.append(f"cell {task.cell}, block {task.block}")
            else:
                assert isinstance(result, np.ndarray)
                levels = study.cells[task.cell].levels
                if store.add_block(task.key, levels, task.block, result, answer.seconds):
                    computed, trials = computed + 1, trials + len(result)
                progress(before + computed, total, "computing blocks")
    wall = time.perf_counter() - begin
    return RunReport(
        total, before, computed, trials, tuple(given_up), losses, wall, seconds, damaged
    )


def count_blocks(study: Study, share: Share = WHOLE) -> int:
    """Return the number of blocks of a study, or of a part of it."""
    return len(share.select_cells(study)) * len(share.select_blocks(study))


def count_stored(study: Study, store: StudyStore, share: Share = WHOLE) -> int:
    """Return how many of these blocks are stored."""
    blocks = share.select_blocks(study)
    return sum(store.count_blocks(cell.levels, blocks) for cell in share.select_cells(study))


def list_missing_tasks(
    study: Study,
    store: StudyStore,
    poses: Mapping[str, CellPoses | None],
    given_up: list[str],
    share: Share = WHOLE,
) -> Iterator[BlockTask | PosesTask | None]:
    """Yield for each cell its poses, where no cell before it has the same, and then its blocks that
    are not stored; None while the next cell needs poses that no worker has returned.

    poses : by the key of their task, which the caller adds; None for those given up, whose
        cells are named in given_up.
    """
    blocks, asked = share.select_blocks(study), set[str]()
    cells = (
        cell
        for cell in share.select_cells(study)
        if store.count_blocks(cell.levels, blocks) < len(blocks)
    )
    waiting = deque[tuple[Cell, dict[str, Any], str]]()
    while True:
        needs_more = not waiting or (waiting[0][2] not in poses and len(waiting) < MOST_WAITING)
        if needs_more and (cell := next(cells, None)) is not None:
            content = describe_cell(study, cell)
            task = make_poses_task(content)
            waiting.append((cell, content, task.key))
            if task.key not in asked:
                asked.add(task.key)
                yield task
        elif not waiting:
            return
        elif waiting[0][2] not in poses:
            yield None
        else:
            cell, content, key = waiting.popleft()
            if (known := poses[key]) is None:
                given_up.append(f"cell {cell.number}, poses")
                continue
            for first in range(0, len(blocks), LISTED):
                listed = blocks[first : first + LISTED]
                stored = store.list_keys(cell.levels, listed)
                for of_block in (content | {"block": block} for block in listed):
                    if compute_key(of_block) not in stored:
                        yield make_block_task(cell.number, of_block, known)


MOST_BLOCKS = 4  # cells of which a block is computed at most; further cells are estimated from them
LONGEST = 30.0  # seconds after which no further block is begun


@dataclass(frozen=True)
class TimeEstimate:
    """How long a study takes, by a block of some of its cells.

    measured : cells of which a block was computed. plans : sets of poses to draw or to plan, which
        cells have in common. worker_seconds, seconds : by one worker, and by as many `workers`.
    bytes : of the store. failed : share of the computed trials that failed, and by their code.
    """

    cells: int
    trials: int
    blocks: int
    measured: int
    seconds_per_block: float
    plans: int
    seconds_per_plan: float
    worker_seconds: float
    workers: int
    seconds: float
    bytes: int
    failed: float
    computed: int
    failures: Mapping[str, int]


def estimate_time(
    study: Study, workers: int, progress: Progress = report_no_progress
) -> TimeEstimate:
    """Compute a block of some cells, evenly spread over the study, and estimate the whole.

    Raises LoopcalError: one of these cells cannot be computed; the text names it.
    """
    last = len(study.cells) - 1
    chosen = range(last + 1)
    if last >= MOST_BLOCKS:
        chosen = [round(i * last / (MOST_BLOCKS - 1)) for i in range(MOST_BLOCKS)]
    seconds, trials, planning = [], 0, 0.0
    failures: Counter[str] = Counter()
    poses: dict[str, CellPoses] = {}
    for i, number in enumerate(chosen):
        progress(i, len(chosen), "computing a block")
        content = describe_cell(study, study.cells[number]) | {"block": 0}
        plan = make_poses_task(content)
        if plan.key not in poses:
            poses[plan.key], spent = compute_timed(compute_plan, plan)
            planning += spent
        task = make_block_task(number, content, poses[plan.key])
        scores, spent = compute_timed(compute_block, task)
        outcomes = scores[:, 0]
        seconds.append(spent)
        trials += len(outcomes)
        failures.update(OUTCOMES[int(outcome)] for outcome in outcomes if outcome)
        if sum(seconds) + planning > LONGEST:
            break
    blocks = study.blocks * len(study.cells)
    plans = len({make_poses_task(describe_cell(study, cell)).key for cell in study.cells})
    each, each_plan = sum(seconds) / len(seconds), planning / len(poses)
    return TimeEstimate(
        cells=len(study.cells),
        trials=study.replicates * len(study.cells),
        blocks=blocks,
        measured=len(seconds),
        seconds_per_block=each,
        plans=plans,
        seconds_per_plan=each_plan,
        worker_seconds=each * blocks + each_plan * plans,
        workers=workers,
        seconds=each * math.ceil(blocks / workers) + each_plan * math.ceil(plans / workers),
        bytes=blocks * study.block * len(study.columns) * 8,
        failed=sum(failures.values()) / trials,
        computed=trials,
        failures=failures,
    )


def view_estimate(
    study: Study, estimate: TimeEstimate, format_duration: Callable[[float], str]
) -> list[Block]:
    """Return the page of an estimate."""
    cells = name_count(estimate.cells, "cell")
    lines: list[Block] = [f"{study.title}: {cells}, {estimate.trials} trials"]
    for name, levels in study.levels.items():
        separator = "; " if any("," in level for level in levels) else ", "
        lines.append(f"  {name:<12}{separator.join(levels)}")
    total = format_duration(estimate.seconds)
    plural = "es" if estimate.workers > 1 else ""
    lines.append(
        f"A block of {study.block} trials takes {estimate.seconds_per_block:.2g} s; the study "
        f"takes about {total} with {estimate.workers} process{plural}, and "
        f"{max(estimate.bytes / 1e6, 0.1):.1f} MB"
    )
    if any(is_planned(level) for level in study.poses.values()):
        times = "once" if estimate.plans == 1 else f"{estimate.plans} times"
        lines.append(f"This includes planning poses, {estimate.seconds_per_plan:.2g} s {times}")
    return [*lines, *explain_failures(estimate.failures, estimate.computed)]


def study(
    source: str | Path | Study,
    folder: str | Path,
    *,
    workers: int = 1,
    executor: Executor | None = None,
    resume: bool = False,
    quick: bool = False,
    progress: Progress = report_no_progress,
    threads: int = 1,
) -> StudyResult:
    """Run a study of simulated calibrations, and return its results.

    Parameters
    ----------
    source : a study file, or a `Study`. folder : to make, or to continue.
    workers : processes that compute; 1 computes in this process. In a script, more of them need
        `if __name__ == "__main__":` around the call.
    executor : other workers, such as `Dask("tcp://host:8786")`.
    resume : continue a folder of this study, which may have got more replicates or levels.
    quick : run the quick tier of the file. progress : receives the blocks that are stored.
    threads : that compute one block, in each process; numbers do not depend on it.

    Raises
    ------
    FileError : the study file or the folder cannot be used. StudyError : fewer than one worker, or
        none can be reached.
    EstimationError : no threads.

    Notes
    -----
    When it is interrupted, what was computed stays in the folder; continue with `resume`.
    """
    path = as_path(folder, "study folder")
    given = StudySource(source) if isinstance(source, Study) else read_source(source, quick)
    check_threads(threads)
    chosen = executor or make_local(workers)
    run_study(given, path, chosen, resume, progress=progress, threads=threads)
    return StudyResult(path)


def read_source(path: str | Path, quick: bool = False) -> StudySource:
    """Return the study of a study file."""
    return StudySource(load_study(path, quick), Path(path))


def make_local(workers: int) -> Executor:
    """Return workers on this computer; one worker is this process."""
    return Serial() if workers == 1 else Processes(workers)


def run_study(
    source: StudySource,
    folder: Path,
    executor: Executor,
    resume: bool = False,
    share: Share = WHOLE,
    progress: Progress = report_no_progress,
    threads: int = 1,
) -> RunReport:
    """Compute what is missing in the folder of a study; see `open_study` and `run_blocks`."""
    with open_study(folder, source, resume) as store:
        return run_blocks(source.study, store, executor, share, progress, threads)


ROBOT, TRUTH, DATA = "robot.yaml", "truth.yaml", "measurements.csv"
"""Files of the folder of inputs: the nominal robot, the true machine, and what was measured."""

# The folder of inputs; its document says which trial it is.
INPUTS = FolderKind("trial", "trial.json", ("study", "cell", "trial"), (ROBOT, TRUTH, DATA))


@dataclass(frozen=True, eq=False)
class Replay:
    """A calibrated trial: the report and the document of its run folder, and the folder of its
    inputs. findings : that files or calibration differ from the cell in spreads or method.
    """

    report: CalibrationReport
    document: dict[str, Any]
    inputs: Path
    findings: tuple[Finding, ...]


def calibrate_trial(
    folder: Path,
    cell: int,
    trial: int,
    output: Path,
    command: Sequence[str] = (),
    force: bool = False,
    progress: Progress = report_no_progress,
) -> Replay:
    """Calibrate the machine of one trial with all checks, and write its run folder; cell
    and trial count from 0.

    A second folder beside it, `NAME-input`, gets the robot file, the measurements and the true
    machine, for `loopcal calibrate`.

    Raises DataError: the study has no such cell or trial. FileError: a folder cannot be used.
    LoopcalError: the calibration is refused; the text says why.
    """
    study = read_study(folder)
    prepared, truth, data = replay_trial(study, cell, trial)
    robot, method = prepared.robot, prepared.content.method
    if method.method == PER_LEG:  # the reason for which such a fit is refused
        fit_per_leg(robot, data, method)
    levels, limits = study.cells[cell].levels, study.scores
    options = CalibrationOptions(
        fit=prepared.fit_options,
        limit_position=limits.limit_position,
        limit_angle=limits.limit_angle,
    )
    refuse_folder(output, RUN, force)
    place = output.with_name(f"{output.name}-input")
    refuse_folder(place, INPUTS, force)
    contents = {
        ROBOT: format_robot(robot),
        TRUTH: format_robot(truth),
        DATA: format_measurements(data, robot, states_use=bool(data.is_held_out.any())),
    }
    document = {"study": study.title, "cell": dict(levels), "trial": trial}
    files = {name: text.encode() for name, text in contents.items()}
    write_result_folder(place, INPUTS, document, files, force=force)
    paths = {"robot": place / ROBOT, "data": place / DATA}
    report = calibrate(robot, data, options, progress)
    save_run(report, output, paths, command, force)
    errors = study.errors[levels[FACTORS["errors"]]]
    is_changed = errors.tolerance_factor != 1.0 or bool(errors.tolerances)
    findings = [report_finding("store.replay-tolerances", file=ROBOT)] if is_changed else []
    if method.is_published:
        level = levels[FACTORS["methods"]]
        findings.append(report_finding("store.replay-method", method=level))
    return Replay(report, build_document(report, paths, command), place, tuple(findings))
