# SPDX-License-Identifier: Apache-2.0
"""The paper's simulation for many drawn machines: LS, RE and TSVD at every lambda and k.

A situation is one structure with measurement in six or in five coordinates. As in the paper the
true machine decides which setting is best: the bottom of the curve, the smallest product of the
errors in position and angle at equal readings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.published_steps import penalize_ridge, penalize_truncated
from loopcal.papers.tsvd_2016.machines import Study
from loopcal.papers.tsvd_2016.steps import iterate
from loopcal.typing import BoolArray, FloatArray, IntArray

LS, RANKED, RE, TSVD = "LS", "LS with rank detection", "RE", "TSVD"

LAMBDAS = np.logspace(-6.0, 4.0, 11)
"""Of RE, wider than the range from 1e-5 to 1 that the paper states for the best one."""
TOGETHER = 10
"""Machines at a time, for memory."""
SHORT = 19
"""Iterations of RE after which its curves are examined, too: one of the states in its history."""
GAIN = 1.05
"""A curve has an interior minimum where both of its ends are this many times higher."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """One algorithm with one setting for each of t machines.

    Attributes
    ----------
    settings : (t,) lambda or k. iterations : (t,). errors : (t, 5), see MEASURES, infinite where
        diverged. commanded : (t, 2), see COMMANDED, infinite where diverged.
    """

    settings: FloatArray
    iterations: IntArray
    errors: FloatArray
    commanded: FloatArray


@dataclass(frozen=True, eq=False)
class Situation:
    """One structure, t drawn machines, and the paper's methods.

    Attributes
    ----------
    name : of the structure. freedoms : measured coordinates, 6 or 5.
    lambdas, ks : (l,), (k,) settings of RE and TSVD; the first k is the number of parameters: LS.
    ridge, truncated : (t, l, 5), (t, k, 5) errors at them, see MEASURES, infinite where diverged.
    short : (t, l, 5) errors of RE after `SHORT` iterations, infinite where diverged before.
    chosen : by algorithm; RE and TSVD at the bottom of their curves, TSVD with less than all k.
    exact : (t, 5) errors of LS with rank detection, measured without noise.
    """

    name: str
    freedoms: int
    lambdas: FloatArray
    ks: IntArray
    ridge: FloatArray
    truncated: FloatArray
    short: FloatArray
    chosen: dict[str, Chosen]
    exact: FloatArray

    def __len__(self) -> int:
        return len(self.ridge)

    @property
    def label(self) -> str:
        """Structure and measurement."""
        return f"{self.name}, {self.freedoms}-DOF"

    def get_curves(self, algorithm: str) -> FloatArray:
        """Return the errors (t, s, 5) at every setting of "RE" (LS, then rising lambda) or "TSVD"
        (falling k).
        """
        if algorithm == TSVD:
            return self.truncated
        return np.concatenate([self.truncated[:, :1], self.ridge], axis=1)

    def get_settings(self, algorithm: str) -> FloatArray:
        """Return the settings (s,) of `get_curves`; a lambda of 0 is LS."""
        if algorithm == TSVD:
            return self.ks.astype(np.float64)
        return np.array([0.0, *self.lambdas])

    def compute_rises(self, algorithm: str, measure: int) -> FloatArray:
        """Return how many times higher the ends of each machine's curve are than its minimum, (t,);
        see `compute_rise`.
        """
        return compute_rises(self.get_curves(algorithm)[:, :, measure])

    def compare_unseen(self, algorithm: str) -> FloatArray:
        """Return errors (t, 2) relative to LS with a setting that was best on other machines.

        Each half of the machines takes the setting at the bottom of the median curve of the other
        half. Position and angle; infinite where the algorithm diverged, 0 where only LS did.
        """
        curves = self.ridge if algorithm == RE else self.truncated[:, 1:]
        ratios = np.empty((len(self), 2))
        for half in (0, 1):
            other = np.median(curves[1 - half :: 2, :, :2], axis=0)
            best = find_bottom(other)
            ratios[half::2] = _divide(
                curves[half::2, best, :2], self.chosen[LS].errors[half::2, :2]
            )
        return ratios


def compute_rise(curve: FloatArray) -> float:
    """Return the lower end of a curve (s,), relative to its least inner value; 0 with no inside.

    Settings that diverged are no part of the curve.
    """
    usable = curve[np.isfinite(curve)]
    if len(usable) < 3:
        return 0.0
    return float(min(usable[0], usable[-1]) / usable[1:-1].min())


def compute_rises(curves: FloatArray) -> FloatArray:
    """Return `compute_rise` of each of the curves (t, s)."""
    return np.array([compute_rise(curve) for curve in curves])


def has_interior_minimum(curve: FloatArray, gain: float = GAIN) -> bool:
    """Return whether both ends of a curve (s,) are at least `gain` times its inner minimum."""
    return compute_rise(curve) > gain


def find_bottom(errors: FloatArray) -> int:
    """Return the place of the smallest product of position and angle error in (s, 2 or more)."""
    product = errors[:, 0] * errors[:, 1]
    return int(np.argmin(np.where(np.isnan(product), np.inf, product)))


def run_situation(measured: Study, progress: Callable[[str], None] = lambda _: None) -> Situation:
    """Run the paper's methods on drawn machines; `progress` is told how far."""
    p, t = len(measured.robot.parameters), len(measured.trials)
    ks = np.arange(p, p // 3, -1)
    penalty = np.concatenate([penalize_truncated(ks, p), penalize_ridge(LAMBDAS, p)])
    settings = np.concatenate([ks.astype(np.float64), LAMBDAS])
    curves, counts, values, early = [], [], [], []
    for first in range(0, t, TOGETHER):
        progress(f"{measured.name}, {measured.freedoms}-DOF, machine {first + 1} of {t}")
        machines = np.arange(first, min(first + TOGETHER, t))
        run = iterate(
            measured, np.tile(penalty, (len(machines), 1)), np.repeat(machines, len(penalty))
        )
        shape = (len(machines), len(penalty), -1)
        curves.append(measured.compute_output_errors(run.values, run.machine).reshape(shape))
        counts.append(run.count.reshape(shape[:2]))
        values.append(run.values.reshape(shape))
        state = min(int(np.searchsorted(run.done.max(axis=1), SHORT)), len(run.done) - 1)
        is_ridge = np.tile(np.arange(len(penalty)) >= len(ks), len(machines))
        short = measured.compute_output_errors(run.history[state, is_ridge], run.machine[is_ridge])
        early.append(short.reshape(len(machines), len(LAMBDAS), -1))
    errors = mark_diverged(np.concatenate(curves))
    count, value = np.concatenate(counts), np.concatenate(values)
    machines, null = np.arange(t), 6 - measured.freedoms
    places = {
        LS: np.zeros(t, np.int64),
        RANKED: np.full(t, null),
        RE: len(ks) + np.array([find_bottom(curve) for curve in errors[:, len(ks) :]]),
        TSVD: 1 + np.array([find_bottom(curve) for curve in errors[:, 1 : len(ks)]]),
    }
    chosen = {
        algorithm: Chosen(
            settings[place],
            count[machines, place],
            errors[machines, place],
            mark_diverged(measured.compute_commanded_errors(value[machines, place])),
        )
        for algorithm, place in places.items()
    }
    exact = measured.exact
    free = iterate(exact, penalize_truncated(np.array([p - null]), p), machines)
    return Situation(
        measured.name,
        measured.freedoms,
        LAMBDAS,
        ks,
        errors[:, len(ks) :],
        errors[:, : len(ks)],
        mark_diverged(np.concatenate(early)),
        chosen,
        mark_diverged(exact.compute_output_errors(free.values)),
    )


def mark_diverged(errors: FloatArray) -> FloatArray:
    """Count diverged machines as infinitely wrong, so that medians stay honest."""
    return np.where(np.isnan(errors), np.inf, errors)


def _divide(errors: FloatArray, reference: FloatArray) -> FloatArray:
    is_lost: BoolArray = ~np.isfinite(errors)
    with np.errstate(invalid="ignore"):
        return np.where(is_lost, np.inf, errors / reference)
