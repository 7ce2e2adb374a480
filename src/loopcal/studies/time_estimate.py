# SPDX-License-Identifier: Apache-2.0
"""Estimate how long a study takes, by computing one block of some of its cells."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from loopcal.findings.wording import name_count
from loopcal.report.text_page import Block
from loopcal.studies.results.summary_view import explain_failures
from loopcal.studies.simulation.fits import OUTCOMES
from loopcal.studies.simulation.poses import CellPoses, compute_poses, is_planned
from loopcal.studies.simulation.tasks import compute_block, make_block_task, make_poses_task
from loopcal.studies.specification.cells import Cell, list_factors
from loopcal.studies.specification.keys import compute_key, describe_block
from loopcal.studies.specification.study import Study
from loopcal.typing import Progress, report_no_progress

MOST_BLOCKS = 4
"""Cells of which a block is computed at most; further cells are estimated from them."""

LONGEST = 30.0
"""Seconds after which no further block is begun."""


@dataclass(frozen=True)
class TimeEstimate:
    """How long a study takes.

    Attributes
    ----------
    cells, trials, blocks : of the study. measured : cells of which a block was computed.
    seconds_per_block : mean of these blocks. plans : sets of poses to draw or to plan, which cells
    have in common. seconds_per_plan : mean of those of the measured cells.
    worker_seconds : of the study, by one worker.
    workers : processors of this computer. seconds : of the study by as many processes.
    bytes : of its store. failed : share of the trials of these blocks that failed.
    computed : trials of these blocks. failures : code -> trials of these blocks.
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

    Raises
    ------
    LoopcalError : one of these cells cannot be computed; the text names it.
    """
    chosen = _spread(study.cells, MOST_BLOCKS)
    seconds, trials = [], 0
    failures: dict[str, int] = {}
    poses: dict[str, CellPoses] = {}
    planning = 0.0
    for i, cell in enumerate(chosen):
        progress(i, len(chosen), "computing a block")
        content = describe_block(study, cell, 0)
        plan = make_poses_task(content)
        if plan.key not in poses:
            begin = time.perf_counter()
            poses[plan.key] = compute_poses(json.loads(plan.content))
            planning += time.perf_counter() - begin
        task = make_block_task(compute_key(content), cell.number, content, poses[plan.key])
        begin = time.perf_counter()
        result = compute_block(task)
        seconds.append(time.perf_counter() - begin)
        trials += len(result.values)
        for code in (OUTCOMES[int(number)] for number in result.values[:, 0] if number):
            failures[code] = failures.get(code, 0) + 1
        if sum(seconds) + planning > LONGEST:
            break
    blocks = study.blocks * len(study.cells)
    plans = len({make_poses_task(describe_block(study, cell, 0)).key for cell in study.cells})
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
    for name in list_factors(study):
        levels = dict.fromkeys(cell.levels[name] for cell in study.cells)
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


def _spread(cells: tuple[Cell, ...], count: int) -> list[Cell]:
    """Return some cells, evenly spread, with the first and the last."""
    if len(cells) <= count:
        return list(cells)
    return [cells[round(i * (len(cells) - 1) / (count - 1))] for i in range(count)]
