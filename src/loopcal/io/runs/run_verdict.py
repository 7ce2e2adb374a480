# SPDX-License-Identifier: Apache-2.0
"""Whether the numbers of a run may be written for a machine: corrected robot, controller, commands.

A fit that did not converge or missed a quality gate is kept in its run folder, to be looked at, but
its numbers belong on no machine. Its robot file has a name of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.findings import Finding, report_finding
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.robot.identified_table import NOT_CALIBRATED

if TYPE_CHECKING:
    from loopcal.workflow import CalibrationReport

ROBOT, FAILED_ROBOT = "robot.yaml", "robot-not-calibrated.yaml"
"""The corrected robot file of a run, and that of a calibration that failed."""

FAILED_VERDICT, CONVERGED = "not_calibrated", "converged"
"""Verdict of a calibration that failed, and status of a fit that converged, in result.json."""

WARNING = f"""\
{NOT_CALIBRATED}: the calibration that made this file failed; see result.json beside it.
"""


def name_robot_file(report: CalibrationReport, force: bool = False) -> str:
    """Return the name of a report's robot file; `force` names a failed one like any other."""
    return FAILED_ROBOT if report.failures and not force else ROBOT


def list_reasons(failures: Iterable[object]) -> tuple[str, ...]:
    """Return the sentences of failures without their last full stop, to be joined."""
    return tuple(str(failure).strip().rstrip(".") for failure in failures)


def find_run_failure(path: Path, result: Mapping[str, Any]) -> Finding | None:
    """Return why the numbers of a run are not for a machine; None where they are, or of no run.

    Parameters
    ----------
    path : of the run. result : content of result.json; empty for a robot file.

    Returns
    -------
    `gates.run-not-calibrated` where the run failed, or `gates.run-without-verdict` where it was
    made before runs had a verdict and does not state that its gates were met.
    """
    if not result:
        return None
    status = str(result.get("fit", {}).get("status", ""))
    reasons = list_reasons(result.get("reasons") or ())
    if status not in ("", CONVERGED) and not reasons:
        reasons = (f"the fit did not converge ({status.replace('_', ' ')})",)
    has_failed = result.get("verdict") == FAILED_VERDICT or result.get("passed") is False
    if has_failed or reasons:
        return report_finding("gates.run-not-calibrated", run=str(path), reasons=reasons)
    if "verdict" not in result and (status != CONVERGED or "passed" not in result):
        return report_finding("gates.run-without-verdict", run=str(path))
    return None


def find_file_failure(path: Path) -> Finding | None:
    """Return `gates.run-not-calibrated` for a robot file that states it; None for other paths."""
    if not path.is_file() or not read_yaml(path, "robot file").text.startswith(NOT_CALIBRATED):
        return None
    return report_finding("gates.run-not-calibrated", run=str(path), reasons=())
