# SPDX-License-Identifier: Apache-2.0
"""Run a study in Python: what `loopcal study run` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.calibration_report import CalibrationReport
from loopcal.estimate.published_steps import identify_per_leg
from loopcal.estimate.trial_identification import check_threads
from loopcal.findings import Finding, report_finding
from loopcal.io.core.outputs import FolderKind, refuse_folder, write_result_folder
from loopcal.io.core.text_file import as_path
from loopcal.io.data.measurement_writer import format_measurements
from loopcal.io.robot.robot_file import format_robot
from loopcal.io.runs.run_folder import build_document, refuse_run_folder, save_run
from loopcal.studies.driver import WHOLE, RunReport, Share, run_blocks
from loopcal.studies.execution.executors import Executor, Processes, Serial
from loopcal.studies.files.study_file import load_study
from loopcal.studies.files.study_folder import StudySource, open_study, read_study
from loopcal.studies.results.study_result import StudyResult
from loopcal.studies.simulation.block import replay_trial
from loopcal.studies.simulation.fits import choose_rule
from loopcal.studies.specification.levels import FACTORS, PER_LEG
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


ROBOT, TRUTH, DATA = "robot.yaml", "truth.yaml", "measurements.csv"
"""Files of the folder of inputs: the nominal robot, the true machine, and what was measured."""

INPUTS = FolderKind(
    "trial", "trial.json", ("study", "cell", "trial"), (ROBOT, TRUTH, DATA), filled_in=()
)
"""The folder of inputs; its document says which trial it is."""


@dataclass(frozen=True, eq=False)
class Replay:
    """A calibrated trial: the report and the document of its run folder, and the folder of its
    inputs. findings : that files or calibration differ from the cell in tolerances or method.
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
    simulated = replay_trial(study, cell, trial)
    if simulated.method.method == PER_LEG:  # the reason for which such a fit is refused
        rule = choose_rule(simulated.method)
        identify_per_leg(simulated.robot, simulated.data, rule.limit, rule.epsilon)
    levels, limits = study.cells[cell].levels, study.scores
    options = CalibrationOptions(
        fit=simulated.options, limit_position=limits.limit_position, limit_angle=limits.limit_angle
    )
    place = output.with_name(f"{output.name}-input")
    refuse_run_folder(output, force)
    refuse_folder(place, INPUTS, force)
    robot, data = simulated.robot, simulated.data
    contents = {
        ROBOT: format_robot(robot),
        TRUTH: format_robot(simulated.truth),
        DATA: format_measurements(data, robot, states_use=bool(data.is_held_out.any())),
    }
    document = {"study": study.title, "cell": dict(levels), "trial": trial}
    files = {name: text.encode() for name, text in contents.items()}
    write_result_folder(place, INPUTS, document, files, force=force)
    paths = {"robot": place / ROBOT, "data": place / DATA}
    report = calibrate(robot, data, options, progress)
    save_run(output, report, paths, command, force)
    errors = study.errors[levels[FACTORS["errors"]]]
    is_changed = errors.tolerance_factor != 1.0 or bool(errors.tolerances)
    findings = [report_finding("store.replay-tolerances", file=ROBOT)] if is_changed else []
    if simulated.method.is_published:
        level = levels[FACTORS["methods"]]
        findings.append(report_finding("store.replay-method", method=level))
    return Replay(report, build_document(report, paths, command), place, tuple(findings))
