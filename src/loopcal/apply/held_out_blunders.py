# SPDX-License-Identifier: Apache-2.0
"""Held-out poses that do not fit: the search, and findings with their largest errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.diagnose import Blunder, PredictionComparison, check_held_out_rows, name_blunders
from loopcal.estimate.inference.fit_uncertainty import FitUncertainty
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.mechanism import Mechanism

if TYPE_CHECKING:
    from loopcal.apply.validation import Validation

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
    return () if check is None else name_blunders(check, data)


def report_blunders(
    blunders: tuple[Blunder, ...], errors: Validation, rest: Validation | None
) -> list[Finding]:
    """Return a finding for each blunder, and whether they dominate the errors.

    Parameters
    ----------
    errors : of all poses. rest : without the blunders.
    """
    findings = [blunder.report(**_find_largest(blunder, errors)) for blunder in blunders]
    if rest is None:
        return findings
    poses = tuple(label for blunder in blunders for label in blunder.poses)
    for quantity, unit in errors.units.items():
        all_rows, without = (e.after.statistics(quantity).rms for e in (errors, rest))
        if all_rows > DOMINATES * without or np.isnan(without):
            quantities = (Quantity(x / unit.factor_to_si, unit.symbol) for x in (all_rows, without))
            error, left = quantities
            dominated = report_finding(
                "validation.blunders-dominate",
                poses=poses,
                quantity=quantity,
                error=error,
                without=left,
            )
            return [*findings, dominated]
    return findings


def _find_largest(blunder: Blunder, errors: Validation) -> dict[str, Any]:
    """Return quantity, target and error of the largest error of a blunder, compared with the noise;
    empty where only actuator readings are compared.
    """
    named = set(blunder.poses)
    worst, result = 0.0, {"quantity": "", "target": "", "error": ""}
    for quantity, of_rows in errors.after.quantities.items():
        floor, unit = errors.noise_floor.rms[quantity], errors.units[quantity]
        for i, row in enumerate(of_rows.rows):
            size = float(of_rows.size[i])
            if named & set(errors.poses[row].split("/")) and size > worst * floor:
                worst = size / floor
                result = {
                    "quantity": quantity,
                    "target": of_rows.targets[i],
                    "error": Quantity(size / unit.factor_to_si, unit.symbol),
                }
    return result
