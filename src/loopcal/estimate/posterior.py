# SPDX-License-Identifier: Apache-2.0
"""The posterior of a fit, direction by direction, also where a covariance would be infinite.

The deviation from the estimate is e - estimate = diag(unit) V y, with independent coordinates y_i
of variance `variance_i`. The variance is infinite for directions of which nothing is known. See
docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.penalties import Method
from loopcal.estimate.residual_test import FEWEST_DEGREES, ResidualTest
from loopcal.estimate.smooth_errors import SmoothErrors
from loopcal.measure.fitted_rows import FittedRows, fitted_rows_from_arrays
from loopcal.measure.kinds.setup_parameters import POSITION_AXES, ROTATION_AXES, linearize_frame
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.statistics import find_distinct
from loopcal.plain_text import represent
from loopcal.results.description import Field
from loopcal.results.storage import restore_arrays, store_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

PREFIX, DISCREPANCY_PREFIX = "posterior_", "discrepancy_"
"""Beginnings of the names of the arrays of a run folder."""

SHOWN_NOISE, SHOWN_READINGS = "posterior_shown_noise", "posterior_reading_sigma"
INFORMATION = ("information_rows", "information_deviations", "information_noise")
BY_MOTIONS = "frames_by_motions"
"""Names of arrays of a run folder."""

NOISE = "noise"
"""Source of the part of the covariance that the noise of the rows causes."""

TOLERANCES = "tolerances"
"""Source of the part that the deviations from nominal cause, where their size was estimated."""


class CovariancePart(NamedTuple):
    """A part of the covariance of the parameters whose size was estimated from data.

    source : what causes it: "noise", "tolerances", or the code of the finding with which it was
        added.
    root : (p, k) [SI], the part is root root'.
    degrees : degrees of freedom of its estimated size; infinite where it is known.
    """

    source: str
    root: FloatArray
    degrees: float

    @property
    def is_added(self) -> bool:
        """Whether it is beside what noise and spreads cause."""
        return self.source not in (NOISE, TOLERANCES)


def combine_degrees(total: FloatArray, squares: Iterable[tuple[FloatArray, float]]) -> FloatArray:
    """Return the effective degrees of freedom (..,) of variances u^2 = `total`, from the variance
    and the degrees of freedom nu_i of each part u_i^2 that was estimated (Welch-Satterthwaite, JCGM
    100, equation G.2b):

        degrees = u^4 / sum(u_i^4 / nu_i)

    They are at least the smallest nu_i; infinite where nothing was estimated, or u is infinite.
    """
    spread = sum((square**2 / nu for square, nu in squares), np.zeros_like(total))
    is_estimated = np.isfinite(total) & (spread > 0.0)
    square = np.where(is_estimated, total, 1.0) ** 2
    return np.divide(square, spread, out=np.full_like(total, np.inf), where=is_estimated)


@dataclass(frozen=True)
class ShownNoise:
    """The variance of whitened rows that residuals alone show, in units of the stated one.

    variance : that of the residuals that no parameter explains. degrees : its degrees of freedom.
    used : the variance that the covariance of the fit contains.
    """

    variance: float
    degrees: float
    used: float

    @property
    def is_known(self) -> bool:
        """Whether at least five degrees of freedom determine it."""
        return self.degrees >= FEWEST_DEGREES and self.variance > 0.0


def find_shown_noise(decomposition: Decomposition, test: ResidualTest) -> ShownNoise | None:
    """Return the noise that the residuals of a fit show (t = 1); None without intervals, or where
    a loss chose the weights by the residuals.
    """
    if not test.intervals or test.weighted:
        return None
    degrees = float((decomposition.rows - decomposition.rank)[0])
    variance = float(decomposition.unexplained[0]) / degrees if degrees > 0.0 else np.nan
    return ShownNoise(variance, degrees, test.sigma_scale**2)


@dataclass(frozen=True, eq=False)
class DataInformation:
    """What the data of a fit say of its parameters, without any tolerance or penalty: rows
    B (e - nominal) = deviations + noise. What lies outside their range says nothing of e.

    rows : (r, p) B [1 / SI]. deviations : (r,) right-hand sides [1].
    variance : of the noise of a row, in units of the stated one: what the residuals show, or else
        what the fit uses; NaN without intervals. degrees : its degrees of freedom.
    """

    rows: FloatArray
    deviations: FloatArray
    variance: float
    degrees: float

    __repr__ = represent


def describe_information(
    free: FreeParameters, decomposition: Decomposition, test: ResidualTest, shown: ShownNoise | None
) -> DataInformation:
    """Return what the rows of a fit (t = 1), which follow no penalty, say of the parameters;
    `shown` is the noise that its residuals show.
    """
    variance = test.sigma_scale**2 if test.intervals else np.nan
    degrees = test.noise_degrees
    if shown is not None and shown.is_known:
        variance, degrees = shown.variance, shown.degrees
    return fold_information(free, decomposition, variance, float(degrees))


def fold_information(
    free: FreeParameters, decomposition: Decomposition, variance: float, degrees: float
) -> DataInformation:
    """Return what the rows of trial 0 of a decomposition say, for this noise of a row."""
    d = decomposition.plain()
    is_used = d.used[0]
    rows = d.singular_values[0][is_used, None] * d.inverse[0][is_used] / free.tolerance
    return DataInformation(rows, d.projections[0][is_used], variance, degrees)


INFLATION = "prior.inflation"
"""Source of what tolerances that the data contradict add, and code of its finding."""

DISCREPANCY = "residuals.model-discrepancy"
"""Source of the part of the covariance that the discrepancy causes, and code of its finding."""


@dataclass(frozen=True, eq=False)
class ModelDiscrepancy:
    """Slow errors of the poses of a calibrated machine that no geometry explains.

    errors : phi. root : (p, m) L [SI].
    degrees : (d,) degrees of freedom of the amplitude of each direction.
    directions, variance : (p, p), (p,) of the posterior without the discrepancy.
    test : (4,) of the map of the errors, see `loopcal.diagnose.model_discrepancy.MapTest`.
    mean, axes, left : (m,), (m, m), (m,) expected coefficients given the residuals, their principal
        axes and standard deviations; without entries where the map is no proven gain.
    is_corrected : whether the map corrects the poses.
    """

    errors: SmoothErrors
    root: FloatArray
    degrees: FloatArray
    directions: FloatArray
    variance: FloatArray
    test: FloatArray
    mean: FloatArray
    axes: FloatArray
    left: FloatArray
    is_corrected: bool = False

    __repr__ = represent

    @property
    def parts(self) -> list[tuple[bool, BoolArray, FloatArray]]:
        """Errors of rotation and of place, if any: whether of place, which directions (d,), and
        their columns of `root`.
        """
        of_place = np.asarray(np.linalg.norm(self.errors.amplitude[3:], axis=0) > 0.0)
        k = len(self.errors.centers)
        return [
            (bool(of), of_place == of, self.root[:, np.repeat(of_place == of, k)])
            for of in find_distinct(of_place)
        ]

    def twists(self, T: FloatArray, by_parameters: FloatArray) -> FloatArray:
        """Return twists (n, 6, m) of the platform at poses T (n, 4, 4) by independent errors of
        variance 1, those of each direction of `errors` in turn.

        `by_parameters` (n, 6, p) are the twists by the parameters [per SI]. With the map, they are
        what it leaves: of the variance 1 of a coefficient the share that the data leave, and the
        whole where the map has faded.
        """
        twists = by_parameters @ self.root - self.errors.twists(T)
        if not self.is_corrected:
            return twists
        faded = (1.0 - self.errors.share(T))[..., None, None] ** 2
        left = np.sqrt(faded * (1.0 - self.left**2) + self.left**2)
        return np.asarray((twists @ self.axes) * left)

    def correct(self, T: FloatArray, by_parameters: FloatArray) -> FloatArray:
        """Return the twists (n, 6) that the map adds to calibrated poses T (n, 4, 4), in base axes
        at the platform's origin; `by_parameters` as of `twists`. It fades where errors have nothing
        to do with those at measured poses.
        """
        expected = (self.errors.twists(T) - by_parameters @ self.root) @ self.mean
        return np.asarray(self.errors.share(T)[..., None] * expected)

    def split_squares(self, twists: FloatArray) -> list[tuple[FloatArray, float]]:
        """Return the variances (n, 6) that the errors of each direction cause, from columns
        (n, 6, m) such as `twists`, and the degrees of freedom of each.
        """
        each = np.split(twists, len(self.degrees), axis=2)
        return [
            ((own**2).sum(axis=2), float(degrees))
            for own, degrees in zip(each, self.degrees, strict=True)
        ]


SAME_MOTION = 4e-5
"""Sine of the angle up to which motions of two sets are the same motion."""


class InstrumentFrame(NamedTuple):
    """The frame of an instrument after a fit.

    Its error is a twist (rotation about base axes [rad], displacement of its origin [m]):
    `by_parameters` times the error of the parameters, plus `own` times independent errors of unit
    variance, which the noise causes at a known machine.

    T : (4, 4) T_base_frame [m]. by_parameters : (6, p) [per SI]. own : (6, 6); both are zero for a
        frame that is stated.
    by_motions : (6, 12) by motions of the frames of base and platform, as of `frame_twists`; None
        for a frame that is stated.
    """

    T: FloatArray
    by_parameters: FloatArray
    own: FloatArray
    by_motions: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class FrameKnowledge:
    """How the measurements of a fit determine the frames of the base and the platform.

    unfixed : (12, k) orthonormal motions of both frames that change no measured value, see
        `loopcal.estimate.information`; k = 0 where the measurements determine both frames.
    readings : (m, a) of measured poses, at most some hundred [m, rad].
    instruments : name, such as "tracker" or "monday.tracker" -> its frame.
    """

    unfixed: FloatArray
    readings: FloatArray
    instruments: Mapping[str, InstrumentFrame] = field(default_factory=dict)

    __repr__ = represent

    def add_errors(
        self, names: Sequence[str], values: FloatArray, errors: FloatArray
    ) -> FrameKnowledge:
        """Return frames with further errors of the setup at a known machine: columns `errors` (U,
        k) [SI] of setup parameters of these names and values (U,).
        """
        changed = {}
        for name, frame in self.instruments.items():
            axes = (*ROTATION_AXES, *POSITION_AXES)
            places = [names.index(f"{name}.{a}") for a in axes if f"{name}.{a}" in names]
            if len(places) == len(axes):
                twists = linearize_frame(values[places]) @ errors[places]
                both = np.concatenate([frame.own, twists], axis=1)
                R = np.asarray(np.linalg.qr(both.T, mode="r"))
                changed[name] = frame._replace(own=R.T)
        return replace(self, instruments={**self.instruments, **changed})

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder, which `frames_from_arrays` reads."""
        frames, count = self.instruments.values(), len(self.instruments)
        p = next((frame.by_parameters.shape[1] for frame in frames), 0)
        shapes = {"T": (4, 4), "by_parameters": (6, p), "own": (6, 6)}
        nothing = np.full((6, 12), np.nan)
        motions = [nothing if f.by_motions is None else f.by_motions for f in frames]
        return {
            "frames_unfixed": self.unfixed,
            "frames_readings": self.readings,
            BY_MOTIONS: np.reshape(motions, (count, 6, 12)),
            **{
                f"frames_{name}": np.reshape([getattr(f, name) for f in frames], (count, *shape))
                for name, shape in shapes.items()
            },
            "frames_names": np.array(tuple(self.instruments), dtype=np.str_),
        }


def frames_from_arrays(arrays: Mapping[str, np.ndarray]) -> FrameKnowledge | None:
    """Return the frames in the arrays of a run folder; None where it does not hold them."""
    if BY_MOTIONS not in arrays:
        return None
    names = ("unfixed", "readings", "names", "T", "by_parameters", "own")
    unfixed, readings, labels, *stacked = (arrays[f"frames_{name}"] for name in names)
    motions = [m if np.isfinite(m).all() else None for m in arrays[BY_MOTIONS]]
    instruments = map(InstrumentFrame, *stacked, motions)
    frames = dict(zip(map(str, labels.tolist()), instruments, strict=True))
    return FrameKnowledge(unfixed, readings, frames)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Free parameters of a robot with their uncertainty.

    robot : Mechanism at the estimate. places : (p,) positions of the free parameters in its table.
    unit : (p,) [SI]. directions : (p, p) V.
    variance : (p,) of each direction; infinite for unknown ones, NaN without intervals.
    determined : (p,) True for directions that the rows determine; of the others at most a prior is
        known.
    frames : which frames the measurements determine; None where it is not known.
    parts : the parts of the covariance whose size was estimated from data, with their degrees of
        freedom; what they leave of the covariance counts as known.
    fitted_rows : the measured rows that it comes from, so that they do not count twice; None where
        they are not known.
    discrepancy : slow errors of the poses that no geometry explains; None where none were found.
        Their effect on the parameters is one of the parts.
    shown_noise : the noise that the residuals alone show; None where it is not known.
    information : what the data say without spreads, to compare calibrations; None where it is
        not known.
    reading_sigma : (a,) standard deviations [SI] of the errors of readings at a pose that
        residuals show; None for those that the robot states.
    """

    robot: Mechanism
    places: IntArray
    unit: FloatArray
    directions: FloatArray
    variance: FloatArray
    determined: BoolArray
    frames: FrameKnowledge | None = None
    parts: tuple[CovariancePart, ...] = ()
    fitted_rows: FittedRows | None = None
    discrepancy: ModelDiscrepancy | None = None
    shown_noise: ShownNoise | None = None
    information: DataInformation | None = None
    reading_sigma: FloatArray | None = None

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *(Field(name, is_stored=True) for name in ("unit", "directions", "variance")),
        Field("seen", "determined", is_stored=True),
    )

    __repr__ = represent

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(self.robot.parameters.names[i] for i in self.places)

    @property
    def undetermined(self) -> FloatArray:
        """(p, d) directions that the rows do not determine."""
        return self.directions[:, ~self.determined]

    @property
    def estimate(self) -> FloatArray:
        """(p,) estimates [SI]."""
        return self.robot.values[self.places]

    @property
    def repeatability(self) -> FloatArray:
        """(a,) standard deviations [SI] of the errors of readings at a pose."""
        return self.robot.stated_sigma if self.reading_sigma is None else self.reading_sigma

    @property
    def without_discrepancy(self) -> Posterior:
        """The posterior of the parameters if no slow error of the poses moved them."""
        own = self.discrepancy
        if own is None:
            return self
        parts = tuple(part for part in self.parts if part.source != DISCREPANCY)
        return replace(
            self, directions=own.directions, variance=own.variance, parts=parts, discrepancy=None
        )

    @property
    def root(self) -> FloatArray:
        """(p, k) square root of the covariance [SI], of the k directions of finite variance; NaN
        without intervals.
        """
        is_finite = ~np.isinf(self.variance)
        return (
            self.unit[:, None] * self.directions[:, is_finite] * np.sqrt(self.variance[is_finite])
        )

    def count_degrees(self, effect: FloatArray) -> FloatArray:
        """Return the effective degrees of freedom (..,) of the size of errors, whose square is the
        sum of the squares of the components of `effect` (.., c, p) [per SI]; see `combine_degrees`.
        """
        squares = ((_sum_squares(effect @ part.root), part.degrees) for part in self.parts)
        return combine_degrees(_sum_squares(effect @ self.root), squares)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder, which `posterior_from_arrays` reads: of the parts of
        the covariance the roots beside each other, and the number of the part of each column.
        """
        roots = [part.root for part in self.parts]
        stored = store_arrays(self, PREFIX) | {
            PREFIX + "source": np.array([part.source for part in self.parts], dtype=np.str_),
            PREFIX + "degrees": np.array([part.degrees for part in self.parts]),
            PREFIX + "root": np.concatenate([np.zeros((len(self.unit), 0)), *roots], axis=1),
            PREFIX + "part": np.repeat(np.arange(len(roots)), [root.shape[1] for root in roots]),
        }
        for value in (self.frames, self.fitted_rows):
            stored |= {} if value is None else value.arrays()
        if (own := self.discrepancy) is not None:
            stored |= store_arrays(own, DISCREPANCY_PREFIX)
            stored |= store_arrays(own.errors, DISCREPANCY_PREFIX)
        if (shown := self.shown_noise) is not None:
            stored[SHOWN_NOISE] = np.array([shown.variance, shown.degrees, shown.used])
        if self.reading_sigma is not None:
            stored[SHOWN_READINGS] = self.reading_sigma
        if (data := self.information) is not None:
            noise = np.array([data.variance, data.degrees])
            arrays = (data.rows, data.deviations, noise)
            stored |= dict(zip(INFORMATION, arrays, strict=True))
        return stored


class VarianceSources(NamedTuple):
    """What the variances of a fit are made of, beside its decomposition and penalty.

    noise : variance of the whitened rows; NaN without intervals.
    prior : (1, p) variance of the true coordinates about nominal, from which the bias of the
        penalty is expected; None for 1 / penalty.
    """

    noise: float
    prior: FloatArray | None = None


def compute_posterior(
    robot: Mechanism,
    places: IntArray,
    tolerance: FloatArray,
    decomposition: Decomposition,
    penalty: FloatArray,
    sources: VarianceSources = VarianceSources(1.0),  # noqa: B008
    frames: FrameKnowledge | None = None,
    degrees: float = np.inf,
) -> Posterior:
    """Return the posterior of trial 0 of a decomposition, whose columns are scaled by tolerance.

    `degrees` of freedom of the noise variance are infinite where it is known.
    """
    directions, variance, determined = decomposition.knowledge(penalty, *sources)
    by_noise = tolerance[:, None] * decomposition.noise_roots(penalty, sources.noise)[0]
    return Posterior(
        robot=robot,
        places=places,
        unit=tolerance,
        directions=directions,
        variance=variance,
        determined=determined,
        frames=frames,
        parts=(CovariancePart(NOISE, by_noise, degrees),),
    )


def find_variance_sources(
    decomposition: Decomposition,
    penalty: FloatArray,
    test: ResidualTest,
    method: Method,
    free: FreeParameters,
) -> VarianceSources:
    """Return what the variances of a fit are made of: noise as the test scales it, and the bias of
    the penalty as the stated spreads let it expect.
    """
    prior = method.prior_variance(decomposition, penalty, free)
    is_known = test.intervals and (prior is None or not np.isnan(prior).any())
    return VarianceSources(test.sigma_scale**2 if is_known else np.nan, prior)


def posterior_from_arrays(robot: Mechanism, arrays: Mapping[str, np.ndarray]) -> Posterior:
    """Return the posterior in the arrays of a run folder with this corrected robot.

    EstimationError: it is a robot file, or its robot now has other free parameters.
    """
    if not arrays:
        raise EstimationError.of("prior.no-posterior")
    unit, directions, variance, determined = (arrays[PREFIX + f.name] for f in Posterior.FIELDS)
    places = np.flatnonzero(robot.parameters.free)
    if len(places) != len(unit):
        raise EstimationError.of("prior.other-count", identified=len(unit), free=len(places))
    roots, number = arrays[PREFIX + "root"], arrays[PREFIX + "part"]
    stated = zip(arrays[PREFIX + "source"].tolist(), arrays[PREFIX + "degrees"], strict=True)
    parts = tuple(
        CovariancePart(str(source), roots[:, number == i], float(degrees))
        for i, (source, degrees) in enumerate(stated)
    )
    errors = restore_arrays(SmoothErrors, arrays, DISCREPANCY_PREFIX)
    discrepancy = errors and restore_arrays(
        ModelDiscrepancy, arrays, DISCREPANCY_PREFIX, errors=errors
    )
    rows, deviations, noise = (arrays[name] for name in INFORMATION)
    return Posterior(
        robot,
        places,
        unit,
        directions,
        variance,
        determined.astype(bool),
        frames_from_arrays(arrays),
        parts,
        fitted_rows_from_arrays(arrays),
        discrepancy,
        ShownNoise(*arrays[SHOWN_NOISE].tolist()) if SHOWN_NOISE in arrays else None,
        DataInformation(rows, deviations, *noise.tolist()),
        arrays.get(SHOWN_READINGS),
    )


def _sum_squares(values: FloatArray) -> FloatArray:
    """Return the sum of squares over the last two axes."""
    return np.asarray((values**2).sum(axis=(-2, -1)))
