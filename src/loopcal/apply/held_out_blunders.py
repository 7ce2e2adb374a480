# SPDX-License-Identifier: Apache-2.0
"""Held-out poses that do not fit: the search, and findings with their largest errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.diagnose import check_held_out_rows
from loopcal.findings import Finding, Quantity, report_finding

if TYPE_CHECKING:
    from loopcal.apply.validation import Validation
    from loopcal.diagnose import Blunder, PredictionComparison
    from loopcal.estimate.inference.fit_uncertainty import FitUncertainty
    from loopcal.mechanism import Mechanism

DOMINATES = 2.0
"""Factor by which an rms error must fall without the blunders to be called dominated by them."""


def find_blunders(
    robot: Mechanism, compared: PredictionComparison, uncertainty: FitUncertainty | None
) -> tuple[Blunder, ...]:
    """Return the compared poses that neither the calibration nor the other poses explain.

    Parameters
    ----------
    robot : the calibrated one. uncertainty : of the calibration; None where it is not known, then
        the noise and the other poses decide.
    """
    data, after = compared.data.take(compared.usable), compared.after
    values = dict(zip(after.setup.table.names, after.values[0].tolist(), strict=True))
    check = check_held_out_rows(robot, data, values, after.kept, uncertainty)
    if check is None:
        return ()
    from loopcal.diagnose import name_blunders

    return name_blunders(check, data)


def report_blunders(
    blunders: tuple[Blunder, ...], errors: Validation, rest: Validation | None
) -> list[Finding]:
    """Return a finding for each blunder, and whether they dominate the errors.

    Parameters
    ----------
    errors : of all poses. rest : without the blunders.
    """
    largest = _find_largest(blunders, errors)
    findings = [b.report(**result) for b, result in zip(blunders, largest, strict=True)]
    if rest is None:
        return findings
    poses = tuple(label for blunder in blunders for label in blunder.poses)
    for quantity, unit in errors.units.items():
        all_rows, without = (e.after.statistics(quantity).rms for e in (errors, rest))
        if all_rows > DOMINATES * without or np.isnan(without):
            error, left = (
                None if np.isnan(x) else Quantity(x / unit.factor_to_si, unit.symbol)
                for x in (all_rows, without)
            )
            dominated = report_finding(
                "validation.blunders-dominate",
                poses=poses,
                quantity=quantity,
                error=error,
                without=left,
            )
            return [*findings, dominated]
    return findings


def _find_largest(blunders: Sequence[Blunder], errors: Validation) -> list[dict[str, Any]]:
    """Return quantity, target and error of the largest error of each blunder, compared with the
    noise; empty where only actuator readings are compared.
    """
    owners: dict[str, list[int]] = {}
    for i, blunder in enumerate(blunders):
        for label in blunder.poses:
            owners.setdefault(label, []).append(i)
    of_row = [
        {i for label in poses.split("/") for i in owners.get(label, ())} for poses in errors.poses
    ]
    nothing: dict[str, str | Quantity] = {"quantity": "", "target": "", "error": ""}
    worst, results = [0.0] * len(blunders), [nothing] * len(blunders)
    for quantity, of_rows in errors.after.quantities.items():
        floor, unit = errors.noise_floor.rms[quantity], errors.units[quantity]
        entries = zip(of_rows.rows.tolist(), of_rows.size.tolist(), of_rows.targets, strict=True)
        for row, size, target in entries:
            for i in of_row[row]:
                if size > worst[i] * floor:
                    worst[i] = size / floor
                    error = Quantity(size / unit.factor_to_si, unit.symbol)
                    results[i] = {"quantity": quantity, "target": target, "error": error}
    return results
