# SPDX-License-Identifier: Apache-2.0
"""Run a study in Python: what `loopcal study run` does."""

from __future__ import annotations

from pathlib import Path

from loopcal.estimate.trial_identification import check_threads
from loopcal.io.core.text_file import as_path
from loopcal.studies.driver import WHOLE, RunReport, Share, run_blocks
from loopcal.studies.execution import Executor, Processes, Serial
from loopcal.studies.files.study_file import load_study
from loopcal.studies.files.study_folder import StudySource, open_study
from loopcal.studies.results.study_result import StudyResult
from loopcal.studies.specification.study import Study
from loopcal.typing import Progress, report_no_progress


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
    FileError : the study file or the folder cannot be used. StudyError : no workers.
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
