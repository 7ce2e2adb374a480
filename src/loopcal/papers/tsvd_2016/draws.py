# SPDX-License-Identifier: Apache-2.0
"""Many machines: the paper's methods and the library's over draws of the paper's errors and noise.

The paper's methods take the setting that is best for the true machine. The library's methods choose
theirs from the data; MAP is given the true spread of the errors as its tolerances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import GCV, MAP, LeastSquares, Method, Ridge
from loopcal.estimate.trial_identification import identify_trials
from loopcal.measure.instrument import make_random_stream
from loopcal.papers.tsvd_2016.machines import (
    Study,
    draw_true_values,
    load_machine,
    measure_machines,
)
from loopcal.papers.tsvd_2016.situations import (
    LS,
    RANKED,
    RE,
    TSVD,
    Situation,
    mark_diverged,
    run_situation,
)
from loopcal.typing import BoolArray, FloatArray

BEFORE, TRUE = "before calibration", "true parameters known"
RAW_LS, RAW_RE, RAW_TSVD = "raw LS", "raw RE at its best", "raw TSVD at its best"
RAW_FIVE = "raw LS with rank detection, 5-DOF"
RE_FIVE, TSVD_FIVE = "raw RE at its best, 5-DOF", "raw TSVD at its best, 5-DOF"
WHITENED, CROSS, PRIOR = "whitened LS", "whitened ridge, GCV", "MAP"
HINDSIGHT = "whitened ridge, best lambda in hindsight"
NARROW, WIDE = "MAP, tolerances a third of the spread", "MAP, tolerances three times the spread"
WHITENED_FIVE, PRIOR_FIVE = "whitened LS, 5-DOF", "MAP, 5-DOF"
METHODS = (
    BEFORE, RAW_LS, RAW_RE, RAW_TSVD, RAW_FIVE, RE_FIVE, TSVD_FIVE, WHITENED, CROSS, PRIOR, NARROW,
    WIDE, HINDSIGHT, WHITENED_FIVE, PRIOR_FIVE, TRUE,
)  # fmt: skip
FACTOR = 3.0
"""Between the tolerances of NARROW and WIDE and the true spread."""
GROUPS = 5
"""Groups of machines for claims about medians: each is a smaller draw of the study."""

HINDSIGHT_LAMBDAS = np.logspace(-2.5, 2.5, 11)
"""Of ridge on whitened, scaled rows, where 1 is MAP."""
RESAMPLES = 2000
RESAMPLING = 4  # purpose of a random stream


@dataclass(frozen=True, eq=False)
class Draws:
    """Results of t drawn machines.

    Attributes
    ----------
    name : of the structure. six, five : the paper's methods with 6- and 5-DOF measurement.
    errors : method -> (t, 5), see MEASURES, infinite where diverged.
    commanded : method -> (t, 2), see COMMANDED, infinite where diverged; without HINDSIGHT, which
        takes another lambda for each measure.
    """

    name: str
    six: Situation
    five: Situation
    errors: dict[str, FloatArray]
    commanded: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.six)

    @property
    def situations(self) -> tuple[Situation, Situation]:
        """With 6- and 5-DOF measurement."""
        return self.six, self.five

    def list_groups(self) -> tuple[Draws, ...]:
        """Return groups of machines of about equal size, `GROUPS` or as many as there are machines.

        They hold the errors of the methods; the situations stay those of all machines.
        """
        places = np.array_split(np.arange(len(self)), min(GROUPS, len(self)))
        return tuple(
            replace(self, errors={m: errors[place] for m, errors in self.errors.items()})
            for place in places
        )

    def compute_median(self, method: str) -> FloatArray:
        """Return medians (5,) over the machines."""
        return np.median(self.errors[method], axis=0)

    def compute_interval(self, method: str) -> FloatArray:
        """Return the bootstrap interval (2, 5) of the medians, 95 %."""
        return _interval(np.median(_resampled(self.errors[method]), axis=1))

    def compute_ratio(self, method: str, other: str) -> FloatArray:
        """Return the ratio (5,) of medians, method over other."""
        return self.compute_median(method) / self.compute_median(other)

    def compute_ratio_interval(self, method: str, other: str) -> FloatArray:
        """Return the bootstrap interval (2, 2) of the ratio of medians in position and angle, the
        machines drawn in pairs, 95 %.
        """
        first, second = (self.errors[m][:, :2] for m in (method, other))
        return _interval(
            np.median(_resampled(first), axis=1) / np.median(_resampled(second), axis=1)
        )

    def find_diverged(self, method: str) -> BoolArray:
        """Return for which machines (t,) the method diverged; their errors count as infinite."""
        return np.isinf(self.errors[method][:, 0])


def draw_machines(
    name: str, seed: int, trials: int, progress: Callable[[str], None] = lambda _: None
) -> Draws:
    """Draw machines, measure and identify them by all methods."""
    truth = draw_true_values(load_machine(name), trials, seed)
    whole = measure_machines(name, truth, seed=seed)
    six, five = (run_situation(study, progress) for study in (whole, whole.five))
    progress(f"{name}, methods of loopcal")
    nominal = np.repeat(whole.robot.parameters.nominal[None], trials, axis=0)
    values = {BEFORE: nominal, TRUE: truth}
    methods = {WHITENED: LeastSquares(), CROSS: Ridge(GCV()), PRIOR: MAP()}
    scaled = {NARROW: Ridge(FACTOR**2), WIDE: Ridge(FACTOR**-2)}
    values |= _identify(whole, methods | scaled)
    values |= _identify(whole.five, {WHITENED_FIVE: LeastSquares(), PRIOR_FIVE: MAP()})
    errors = {m: whole.compute_output_errors(v) for m, v in values.items()}
    commanded = {m: whole.compute_commanded_errors(v) for m, v in values.items()}
    errors[HINDSIGHT] = _run_in_hindsight(whole)
    for method, algorithm, situation in (
        (RAW_LS, LS, six),
        (RAW_RE, RE, six),
        (RAW_TSVD, TSVD, six),
        (RAW_FIVE, RANKED, five),
        (RE_FIVE, RE, five),
        (TSVD_FIVE, TSVD, five),
    ):
        errors[method] = situation.chosen[algorithm].errors
        commanded[method] = situation.chosen[algorithm].commanded
    return Draws(
        name,
        six,
        five,
        {m: mark_diverged(errors[m]) for m in METHODS},
        {m: mark_diverged(commanded[m]) for m in METHODS if m != HINDSIGHT},
    )


def _identify(measured: Study, methods: Mapping[str, Method]) -> dict[str, FloatArray]:
    """Return values (t, p) by the library's methods: rows whitened, columns scaled by tolerance."""
    return {
        name: identify_trials(measured.robot, measured.trials, method).values
        for name, method in methods.items()
    }


def _run_in_hindsight(measured: Study) -> FloatArray:
    """Return the least error of each machine and measure over HINDSIGHT_LAMBDAS."""
    start, tried = None, []
    for lam in HINDSIGHT_LAMBDAS:
        fit = identify_trials(
            measured.robot, measured.trials, Ridge(float(lam)), options=FitOptions(start=start)
        )
        start = fit.values
        tried.append(measured.compute_output_errors(fit.values))
    return np.min(tried, axis=0)


def _resampled(values: FloatArray) -> FloatArray:
    """(RESAMPLES, t, ..) machines drawn with replacement, always the same ones."""
    t = len(values)
    return values[make_random_stream(0, 0, RESAMPLING).integers(0, t, (RESAMPLES, t))]


def _interval(medians: FloatArray) -> FloatArray:
    return np.quantile(medians, [0.025, 0.975], axis=0, method="nearest")  # some may be infinite
