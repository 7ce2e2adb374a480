# SPDX-License-Identifier: Apache-2.0
"""Measurements read in one way, or in many ways at once, against a robot free within its tolerances.

Ways that differ in measured values share poses and sensitivities and are the trials of one set of rows; a way to read the
readings has poses of its own. Every way has its own frames, targets and surfaces, and its own blunders left out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import engine
from loopcal.calibrate.local import Own
from loopcal.calibrate.rows import Rows, rows_of
from loopcal.calibrate.scaling import Unknowns
from loopcal.calibrate.sensed import Sensed
from loopcal.errors import DataError
from loopcal.linalg import FloatArray
from loopcal.measure import LocalUnknowns, Measurements
from loopcal.measure.hypotheses import Hypothesis
from loopcal.mechanism import forward
from loopcal.mechanism.trials import plainly_reached

FEWEST = 8
"""Equations beyond those that unknown frames take up, without which nothing is said."""

FAR, MOST_LEFT_OUT = 5.0, 0.25
"""Rows this many times the median row away are blunders, up to this share of the rows: their own check names them."""

LARGEST = 30.0
"""Tolerances a parameter may be off while the steps below are taken; beyond, the first-order misfit stands."""

ROUNDS = 3
"""Gauss-Newton steps by which the stated convention and the best other one are compared in the end."""


def quick_misfit(free: Unknowns, data: Measurements) -> float:
    """The misfit of measurements as written, unknown frames sought from their nominal values only: an upper bound.

    It costs one step of a fit. Infinite where a pose is out of reach; NaN where too few rows are left.
    """
    rows = rows_of(free, data, data.unknowns)
    if rows.own is not None:
        rows.own.started[:] = True
    z = free.deviation(free.robot.values[None])
    with np.errstate(all="ignore"):
        factor, cost = rows.fold(z, np.arange(1))
        found = _rms(_cost(factor, np.zeros_like(z)), rows.rows) if np.isfinite(cost[0]) else np.full(1, np.inf)
    return float(found[0])


class ReadAs:
    """Measurements read in one way, or in t ways that share readings: their rows at the robot's own values.

    Parameters
    ----------
    free : the robot's parameters. data : the measurements under the (first) reading; poses out of reach are left out.
    ways : hypotheses about the values of `data`, one for each trial; default: as written.
    hypothesis : what `data` supposes already, where it is not what was written.
    """

    def __init__(
        self, free: Unknowns, data: Measurements, ways: tuple[Hypothesis, ...] = (), hypothesis: Hypothesis | None = None
    ) -> None:
        self.free, self.hypothesis, self.found = free, hypothesis, float("nan")
        solved = plainly_reached(free.robot, free.robot.values[None], data.readings[None])[0]
        fewest = (1.0 - MOST_LEFT_OUT) * data.n_poses
        if hypothesis is None and solved.sum() < fewest:
            solved = forward(free.robot, data.readings).converged
        self.reached, self.poses = int(solved.sum()), data.n_poses
        self.enough = self.reached >= fewest
        self.whole = data
        self.data = data if solved.all() or not self.enough else data.take(solved)
        self.t = max(len(ways), 1)
        self.seen = [i for i, o in enumerate(self.data.observations) if len(o)]
        self.local = self.data.unknowns
        self.sensed = self._sensed(ways)
        self.z = np.repeat(free.deviation(free.robot.values[None]), self.t, axis=0)
        self.rows = self._rows(self.sensed)

    def misfit(self) -> float:
        """The misfit of the first way; infinite where poses are out of reach, NaN where too few rows are left."""
        return float(self.misfits()[0])

    def misfits(self) -> FloatArray:
        """The misfit of every way, to first order about the robot's values."""
        if not self.enough:
            return np.full(self.t, np.inf)
        try:
            factor, _ = self.rows.fold(self.z, np.arange(self.t))
        except DataError:  # where something is cannot be found from these rows: the fit says it in its own words
            return np.full(self.t, np.nan)
        return _rms(_cost(factor, np.zeros_like(self.z)), self.rows.rows)

    def leave_out(self) -> None:
        """Leave out the rows of each way that stand far from its others; to be called after `misfits`."""
        if not self.enough:
            return
        every = np.arange(self.t)
        sd = self.allowed()
        weights = []
        ratios = [_row_rms(r.whitened, a) for r, a in zip(self.rows.residuals(self.z), sd, strict=True)]
        together = np.concatenate(ratios, axis=1)
        middle = np.nanmedian(together, axis=1)
        limit = np.maximum(FAR * middle, np.nanquantile(together, 1.0 - MOST_LEFT_OUT, axis=1))
        if not np.any(together > limit[:, None]):
            return
        for s, ratio in zip(self.sensed, ratios, strict=True):
            kept = ~(ratio > limit[:, None])
            weights.append(replace(s, whitener=s.trials(every)[1] * kept[..., None, None]))
        self.rows = self._rows(tuple(weights))

    def allowed(self) -> list[FloatArray]:
        """Standard deviations (r, m) [1] of whitened residuals by tolerances and noise, after `misfits`."""
        found = [np.ones(s.whitener.shape[1:3]) for s in self.sensed]
        for block, given in zip(self.rows.blocks, self.rows.linearised(self.z[:1]), strict=True):
            parts = iter(given)
            for sd, chosen in zip(found, block.rows, strict=True):
                if len(chosen):
                    A = next(parts)[1][..., -len(self.free) - 1 : -1]
                    sd[chosen] = np.sqrt(1.0 + (A**2).sum(axis=-1))
        return found

    def _sensed(self, ways: tuple[Hypothesis, ...]) -> tuple[Sensed, ...]:
        """Rows of every kind; a row that another way of reading leaves without some of its residuals is absent there."""
        made = []
        for i in self.seen:
            o = self.data.observations[i]
            measured = np.stack([way.measured(self.data)[i] for way in ways]) if ways else o.measured[None]
            same = (o.kind.present(measured) == o.present).all(axis=-1)
            white = o.whitener * same[..., None, None]
            made.append(Sensed(o.kind, o.rows, measured, white, self.local.places[i]))
        return tuple(made)

    def _rows(self, sensed: tuple[Sensed, ...]) -> Rows:
        def measurements(trial: int) -> Measurements:
            parts = []
            for i, s in zip(self.seen, sensed, strict=True):
                o = self.data.observations[i]
                values, white = (a[0] for a in s.trials(np.array([trial])))
                parts.append(replace(o, measured=values).reweighted(np.any(white != 0.0, axis=(1, 2)) * o.weight))
            return replace(self.data, observations=tuple(parts))

        places = tuple(s.places for s in sensed)
        local = LocalUnknowns(self.local.table, places)
        own = Own(local, sensed, self.t, len(self.free), measurements) if len(local) else None
        return Rows(self.free, self.data.readings, sensed, self.t, own=own)


def _cost(factor: FloatArray, moved: FloatArray) -> FloatArray:
    """Smallest |R z + r|^2 + |moved + z|^2 (t,) of factors (t, p + 1, p + 1)."""
    t, p = moved.shape
    prior = np.concatenate([np.broadcast_to(np.eye(p), (t, p, p)), moved[..., None]], axis=-1)
    return engine.accumulate(factor, prior)[:, -1, -1] ** 2 if p else factor[:, -1, -1] ** 2


def _rms(cost: FloatArray, rows: np.ndarray) -> FloatArray:
    return np.where(rows >= FEWEST, np.sqrt(cost / np.maximum(rows, 1)), np.nan)


def _row_rms(whitened: FloatArray, sd: FloatArray) -> FloatArray:
    """Root mean square (t, r) of the present residuals (t, r, m) over their sd (r, m); NaN for absent rows."""
    there = whitened != 0.0
    count = there.sum(axis=-1)
    total = ((whitened / sd) ** 2).sum(axis=-1)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def refined(way: ReadAs) -> float:
    """The misfit of the first way after Gauss-Newton steps within the tolerances; infinite where it cannot be found."""
    if not way.enough or not np.isfinite(way.misfit()):
        return np.inf
    z, moved, best = way.z[:1], np.zeros_like(way.z[:1]), np.inf
    p = z.shape[1]
    for _ in range(ROUNDS + 1):
        factor, cost = way.rows.fold(z + moved, np.arange(1))
        if not np.isfinite(cost[0]):
            break
        now = float(_rms(cost + (moved**2).sum(axis=1), way.rows.rows)[0])
        if p == 0 or not now < best:
            best = min(best, now)
            break
        best = now
        whole = engine.accumulate(factor, np.concatenate([np.eye(p), moved.T], axis=1)[None])[0]
        moved = moved - np.linalg.solve(whole[:p, :p], whole[:p, p])[None]
        if np.abs(moved).max() > LARGEST:
            break
    return best
