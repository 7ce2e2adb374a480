# SPDX-License-Identifier: Apache-2.0
"""The errors of several calibrations at the same held-out poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.apply.reused_rows import report_reused_rows
from loopcal.apply.run_comparison.stored_run import StoredRun, list_data_digests
from loopcal.apply.validation import validate
from loopcal.findings import Finding
from loopcal.measure import Measurements

QUANTITIES = ("position", "orientation", "length")
"""Quantities whose errors are compared."""


@dataclass(frozen=True)
class QuantityErrors:
    """Errors of a quantity after calibration [SI]: root mean square and largest of `count`."""

    rms: float
    largest: float
    count: int


@dataclass(frozen=True)
class RunErrors:
    """Errors of a run by quantity.

    Attributes
    ----------
    run : name. own : at the held-out poses of the run itself, which other runs do not share.
    common : at the poses that are common to all runs; empty where there are none.
    """

    run: str
    own: Mapping[str, QuantityErrors]
    common: Mapping[str, QuantityErrors]


def collect_errors(
    runs: Sequence[StoredRun], names: Sequence[str], data: Measurements | None
) -> tuple[tuple[RunErrors, ...], int, tuple[Finding, ...]]:
    """Return the errors of each run, the number of common poses, and findings.

    Parameters
    ----------
    data : other measurements, at which all runs are validated; without it the common poses are
        those that all runs of one data set held out.
    """
    own = [_read_errors(run, None) for run in runs]
    if data is not None:
        results = [_validate(run, data) for run in runs]
        common = [errors for errors, _ in results]
        found_rows = [finding for _, findings in results for finding in findings]
        errors = zip(names, own, common, strict=True)
        return tuple(RunErrors(*fields) for fields in errors), data.n_poses, tuple(found_rows)
    poses = _find_common_poses(runs)
    common = [_read_errors(run, poses) if poses else {} for run in runs]
    errors = zip(names, own, common, strict=True)
    return tuple(RunErrors(*fields) for fields in errors), len(poses), ()


def _validate(
    run: StoredRun, data: Measurements
) -> tuple[dict[str, QuantityErrors], list[Finding]]:
    """Return the errors of a run at other measurements."""
    reused = report_reused_rows(run.fitted_rows, data)
    validation = validate(
        run.robot,
        data,
        before=run.initial_robot,
        nuisance_values=run.nuisance_values,
        nuisance_values_before=run.initial_nuisance_values,
        uncertainty=run.load_uncertainty(),
    )
    errors = {
        name: QuantityErrors(e.statistics.rms, e.statistics.max, e.statistics.count)
        for name, e in validation.after.quantities.items()
    }
    return errors, [] if reused is None else [reused]


def _find_common_poses(runs: Sequence[StoredRun]) -> tuple[str, ...]:
    """Return the poses that all runs of the same files held out: names of poses of different files
    do not mean the same.
    """
    digests = [list_data_digests(run) for run in runs]
    if not digests[0] or any(run_digests != digests[0] for run_digests in digests):
        return ()
    held_out = [((run.result.get("split") or {}).get("held_out") or ()) for run in runs]
    return tuple(label for label in held_out[0] if all(label in others for others in held_out))


def _read_errors(run: StoredRun, poses: Sequence[str] | None) -> dict[str, QuantityErrors]:
    """Return the stored errors at some of the held-out poses; at all of them where None."""
    validation = run.result.get("validation") or {}
    labels = validation.get("poses", ())
    result = {}
    for name in QUANTITIES:
        stored = (validation.get("after") or {}).get(name)
        if not stored or len(stored["errors"]) != len(labels):
            continue
        chosen = [
            error
            for label, error in zip(labels, stored["errors"], strict=True)
            if error is not None and (poses is None or label in poses)
        ]
        if chosen:
            sizes = np.abs(np.array(chosen, dtype=float))
            rms = float(np.sqrt((sizes**2).mean()))
            result[name] = QuantityErrors(rms, float(sizes.max()), len(sizes))
    return result
