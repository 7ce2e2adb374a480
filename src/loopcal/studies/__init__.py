# SPDX-License-Identifier: Apache-2.0
"""Studies: many simulated calibrations, described by a file, resumable and reproducible."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.studies.execution import Dask as Dask
    from loopcal.studies.execution import Processes as Processes
    from loopcal.studies.execution import Ray as Ray
    from loopcal.studies.execution import Serial as Serial
    from loopcal.studies.files.study_file import load_study as load_study
    from loopcal.studies.results.study_result import StudyResult as StudyResult
    from loopcal.studies.simulation.fits import OUTCOMES as OUTCOMES
    from loopcal.studies.simulation.replay import ReplayedTrial as ReplayedTrial
    from loopcal.studies.simulation.replay import replay_trial as replay_trial
    from loopcal.studies.simulation.tasks import BlockResult as BlockResult
    from loopcal.studies.simulation.tasks import BlockTask as BlockTask
    from loopcal.studies.simulation.tasks import compute_block as compute_block
    from loopcal.studies.simulation.tasks import list_tasks as list_tasks
    from loopcal.studies.specification.cells import Cell as Cell
    from loopcal.studies.specification.cells import list_factors as list_factors
    from loopcal.studies.specification.cells import list_varied_factors as list_varied_factors
    from loopcal.studies.specification.scores import ScoreColumn as ScoreColumn
    from loopcal.studies.specification.study import Study as Study
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.studies.execution": "Dask Processes Ray Serial",
            "loopcal.studies.files.study_file": "load_study",
            "loopcal.studies.results.study_result": "StudyResult",
            "loopcal.studies.simulation.fits": "OUTCOMES",
            "loopcal.studies.simulation.replay": "ReplayedTrial replay_trial",
            "loopcal.studies.simulation.tasks": "BlockResult BlockTask compute_block list_tasks",
            "loopcal.studies.specification.cells": "Cell list_factors list_varied_factors",
            "loopcal.studies.specification.scores": "ScoreColumn",
            "loopcal.studies.specification.study": "Study",
        },
    )
