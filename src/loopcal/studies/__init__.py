# SPDX-License-Identifier: Apache-2.0
"""Studies: many simulated calibrations, described by a file, resumable and reproducible."""

from loopcal.studies.cells import Cell as Cell
from loopcal.studies.cells import list_factors as list_factors
from loopcal.studies.cells import list_varied_factors as list_varied_factors
from loopcal.studies.execution import Dask as Dask
from loopcal.studies.execution import Processes as Processes
from loopcal.studies.execution import Ray as Ray
from loopcal.studies.execution import Serial as Serial
from loopcal.studies.fits import OUTCOMES as OUTCOMES
from loopcal.studies.replay import ReplayedTrial as ReplayedTrial
from loopcal.studies.replay import replay_trial as replay_trial
from loopcal.studies.scores import ScoreColumn as ScoreColumn
from loopcal.studies.study import Study as Study
from loopcal.studies.study_file import load_study as load_study
from loopcal.studies.study_result import StudyResult as StudyResult
from loopcal.studies.work import BlockResult as BlockResult
from loopcal.studies.work import BlockTask as BlockTask
from loopcal.studies.work import compute_block as compute_block
