# SPDX-License-Identifier: Apache-2.0
"""What a comparison needs of a calibration, as `loopcal.Run` has it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from loopcal.estimate.inference.fit_uncertainty import FitUncertainty
from loopcal.estimate.inference.posterior import Posterior
from loopcal.findings import Finding
from loopcal.measure import FittedRows
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray


class StoredRun(Protocol):
    """A calibration that was read from its run folder; see `loopcal.Run`."""

    @property
    def path(self) -> Path:
        """The run folder."""
        ...

    @property
    def result(self) -> dict[str, Any]:
        """Content of result.json."""
        ...

    @property
    def robot(self) -> Mechanism:
        """The corrected robot."""
        ...

    @property
    def initial_robot(self) -> Mechanism:
        """The robot before the calibration."""
        ...

    @property
    def nuisance_values(self) -> Mapping[str, float]:
        """Estimates of setup parameters by name [SI]."""
        ...

    @property
    def initial_nuisance_values(self) -> Mapping[str, float]:
        """The same before the calibration."""
        ...

    @property
    def arrays(self) -> Mapping[str, np.ndarray]:
        """Content of arrays.npz."""
        ...

    @property
    def failure(self) -> Finding | None:
        """Why its numbers are not for a machine; None where they are."""
        ...

    @property
    def fitted_rows(self) -> FittedRows | None:
        """The rows that it was fitted to; None where they are not known."""
        ...

    def load_posterior(self) -> Posterior:
        """Return estimates and uncertainties."""
        ...

    def load_uncertainty(self) -> FitUncertainty | None:
        """Return what the fit knows of machine and setup parameters together."""
        ...


def find_row_noise(run: StoredRun) -> dict[str, FloatArray]:
    """Return the standard deviation of the measured values of each kind [SI], from its residuals
    and these divided by it.
    """
    result = {}
    for name, raw in run.arrays.items():
        if not name.startswith("residual_"):
            continue
        whitened = run.arrays.get(name.replace("residual_", "whitened_", 1))
        if whitened is None or whitened.shape != raw.shape or raw.ndim != 2 or not len(raw):
            continue
        usable = np.isfinite(raw) & np.isfinite(whitened) & (whitened != 0.0)
        ratio = np.abs(raw) / np.where(usable, np.abs(whitened), np.inf)
        medians = [
            float(np.median(column[mask])) if mask.any() else 0.0
            for column, mask in zip(ratio.T, usable.T, strict=True)
        ]
        result[name.split("_", 2)[2]] = np.array(medians)
    return result


def list_data_digests(run: StoredRun) -> tuple[str, ...]:
    """Return the SHA-256 of the measurement files of a run."""
    files = run.result.get("made_by", {}).get("inputs", {})
    roles = ("data", "poses")
    return tuple(sorted(f["sha256"] for r, f in files.items() if r.partition("-")[0] in roles))
