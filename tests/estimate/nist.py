# SPDX-License-Identifier: Apache-2.0
"""Reader of the NIST StRD files for nonlinear regression, and their models.

Source: https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml (public domain). The models work
for real and complex numbers alike: derivatives come from a complex step, which has no
cancellation.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

COMPLEX_STEP = 1e-30


@dataclass(frozen=True)
class Certified:
    """A data set with its certified values."""

    name: str
    starts: np.ndarray  # (2, p)
    values: np.ndarray  # (p,)
    standard_errors: np.ndarray  # (p,)
    residual_sum: float
    degrees: int
    y: np.ndarray
    x: np.ndarray


def read_data_set(path: Path) -> Certified:
    """Read one .dat file by its line patterns."""
    lines = path.read_text("ascii").splitlines()
    parameters, residual_sum, degrees = [], None, None
    for line in lines:
        if match := re.match(r"\s*b\d+\s*=\s*(.*)", line):
            parameters.append([float(word) for word in match[1].split()])
        elif line.startswith("Residual Sum of Squares:"):
            residual_sum = float(line.split(":")[1])
        elif line.startswith("Degrees of Freedom:"):
            degrees = int(line.split(":")[1])
    first = max(i for i, line in enumerate(lines) if line.startswith("Data:"))
    rows = np.array(
        [[float(word) for word in line.split()] for line in lines[first + 1 :] if line.strip()]
    )
    table = np.array(parameters)
    assert table.shape[1] == 4
    assert residual_sum is not None
    degrees = len(rows) - len(
        table
    )  # Rat43 prints 9, but its residual standard deviation was made with 11
    y, x = rows.T
    return Certified(
        path.stem, table[:, :2].T.copy(), table[:, 2], table[:, 3], residual_sum, degrees, y, x
    )


def _gauss(b, x):
    return (
        b[0] * np.exp(-b[1] * x)
        + b[2] * np.exp(-((x - b[3]) ** 2) / b[4] ** 2)
        + b[5] * np.exp(-((x - b[6]) ** 2) / b[7] ** 2)
    )


def _lanczos(b, x):
    return b[0] * np.exp(-b[1] * x) + b[2] * np.exp(-b[3] * x) + b[4] * np.exp(-b[5] * x)


def _chwirut(b, x):
    return np.exp(-b[0] * x) / (b[1] + b[2] * x)


def _cubic_over_cubic(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (
        1 + b[4] * x + b[5] * x**2 + b[6] * x**3
    )


def _saturation(b, x):
    return b[0] * (1 - np.exp(-b[1] * x))


def _enso(b, x):
    def wave(cosine, sine, period):
        return cosine * np.cos(2 * np.pi * x / period) + sine * np.sin(2 * np.pi * x / period)

    return b[0] + wave(b[1], b[2], 12.0) + wave(b[4], b[5], b[3]) + wave(b[7], b[8], b[6])


MODELS: dict[str, Callable] = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": _saturation,
    "Chwirut1": _chwirut,
    "Chwirut2": _chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": _enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * np.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "Gauss3": _gauss,
    "Hahn1": _cubic_over_cubic,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Lanczos3": _lanczos,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * np.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Misra1a": _saturation,
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Rat42": lambda b, x: b[0] / (1 + np.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + np.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Thurber": _cubic_over_cubic,
}


def residual_and_jacobian(certified: Certified, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return model - y (m,) and its derivative (m, p) by the parameters."""
    model = MODELS[certified.name]
    shifted = b[:, None, None] + 1j * COMPLEX_STEP * np.eye(len(b))[:, :, None]
    with np.errstate(all="ignore"):
        value = model(b, certified.x) - certified.y
        derivative = np.imag(model(shifted, certified.x)) / COMPLEX_STEP
    return value, np.broadcast_to(derivative, (len(b), len(value))).T


def matching_digits(computed: np.ndarray, certified: np.ndarray) -> float:
    """Return -log10 of the largest relative difference, at most 11 (the digits that NIST prints)."""  # noqa: E501
    worst = np.max(np.abs(computed - certified) / np.abs(certified))
    return 11.0 if worst == 0.0 else min(11.0, float(-np.log10(worst)))
