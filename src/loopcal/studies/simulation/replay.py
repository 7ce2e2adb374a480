# SPDX-License-Identifier: Apache-2.0
"""Repeat one trial of a study: its machine and its measurements, to the last bit."""

from __future__ import annotations

import json
from dataclasses import dataclass

from loopcal.errors import DataError
from loopcal.estimate import FitOptions
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.studies.simulation.block import make_stream, simulate_block
from loopcal.studies.simulation.fits import state_times
from loopcal.studies.simulation.preparation import prepare_cell
from loopcal.studies.simulation.tasks import list_tasks
from loopcal.studies.specification.levels import MethodLevel
from loopcal.studies.specification.study import Study


@dataclass(frozen=True, eq=False)
class ReplayedTrial:
    """A trial of a study.

    Attributes
    ----------
    robot : nominal, with the tolerances of its cell. truth : the true machine.
    data : its measurements. options : with which they are fitted. method : of its cell.
    """

    robot: Mechanism
    truth: Mechanism
    data: Measurements
    options: FitOptions
    method: MethodLevel


def replay_trial(study: Study, cell: int, trial: int) -> ReplayedTrial:
    """Return a trial of a cell; trials of a cell are numbered from 0, over all of its blocks.

    Raises
    ------
    DataError : the study has no such cell or trial.
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
    trials = simulate_block(prepared, make_stream(prepared.seed, block))
    data = state_times(trials.trial(place))
    if prepared.scores.verdict:
        data = prepared.hold_out(data)
    truth = prepared.robot.with_values(trials.truth[place])
    return ReplayedTrial(prepared.robot, truth, data, prepared.fit_options, prepared.method)
