# SPDX-License-Identifier: Apache-2.0
"""Compare what may cause residuals that noise alone does not explain, wrong rows among it.

Each cause h is a component of the variance of the whitened rows, K_h = Z Z' for independent errors
with columns Z of unit variance. What nothing estimated explains of the residuals has the covariance
sigma^2 (1 + tau^2 K_h); its likelihood over that of noise alone, averaged over log tau, is
the evidence of h, and with equal probabilities before the data it gives those after them. A noise
that is larger than stated is K = 1: without it, any other cause would explain too large residuals
of any kind. What parameters and setup leave almost nothing of is no cause that residuals can show.
Few wrong poses are errors of any size in the rows of k of n poses, for each choice of
k of them. The most probable cause is taken into the covariance, and the others are compared again,
until noise alone explains the rest, or rows are wrong, which pull the fit.

Drives have errors at every pose by itself: repeatability, backlash, errors of gears. An error of
variance tau^2 of every reading at every pose is a component of the variance of the whitened rows,
with their derivatives by the readings as columns, which are zero but for those of the pose of a row
(`numerics.statistics.Remainder`). Backlash is an error of the sign of travel from the pose before:
a linear effect, see `residual_patterns`.

Errors of pictures of a board are a board that moved, a picture with another focal length or of a
moving machine, a board that is printed at another scale, and a picture of another pose. Each is a
cause of few sizes: six of a board from a pose on, zoom and center of a picture, its motion from row
to row, the two scales of a print. They compete with errors of any size in all
its corners. See docs/theory/camera.md.
Sources: Patterson and Thompson, Recovery of inter-block information when block sizes are unequal,
Biometrika 58 (1971); docs/theory/residual-patterns.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from loopcal.diagnose.residual_patterns import (
    READING,
    Cause,
    Effect,
    ExplainedResiduals,
    ResidualRows,
    collect_residual_rows,
    list_effects,
    list_shared_errors,
    order_by_time,
    scale_to_range,
    test_effect,
)
from loopcal.errors import LoopcalError
from loopcal.estimate import residual_test
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import evaluate_rows
from loopcal.estimate.result import Identification
from loopcal.estimate.smooth_errors import describe_smooth_errors
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure.kinds.image import Image
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward
from loopcal.numerics import statistics
from loopcal.numerics.split_columns import SplitColumns, span_columns
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

MOVED, ZOOMED, MOVING = "moved-board", "zoomed-picture", "moving-picture"
CHANGING = ("board", "focal", "center")  # items of a kind that these errors change
STEPS = 24  # poses, evenly chosen, from which on a board may be elsewhere
CLEAR, LEAST = 6.0, 0.002  # standard deviations, and size, from which a scale is named
CONFLICT = ("prior.tolerances-inflated", "prior.tolerances-too-narrow")
SHOWN = 3.0  # residuals in sigmas (rms) up to which a picture shows another pose
SIZES = (("rotation", Dimension.ANGLE), ("position", Dimension.LENGTH))


def list_picture_effects(linear: FitLinearization, rows: ResidualRows) -> list[Effect]:
    """Return the effects of errors of pictures on the whitened rows; none without pictures."""
    slopes: dict[str, FloatArray] = {}  # board -> (R, 11), see `_linearize_pictures`
    for number, kind, of_kind in _linearize_pictures(linear):
        own = np.flatnonzero(rows.kind == number)
        columns = slopes.setdefault(kind.board, np.zeros((len(rows.residual), 11)))
        columns[own] = of_kind[rows.row[own], rows.column[own]]
    if not slopes:
        return []
    pose, labels = rows.locate_poses(linear.data), linear.data.labels
    seen = np.unique(pose[np.any(list(slopes.values()), axis=(0, 2))])
    of_pose, effects = (*[SIZES[0]] * 3, *[SIZES[1]] * 3), list[Effect]()
    for board, columns in slopes.items():
        for k in seen[statistics.choose_evenly(len(seen), STEPS)][1:]:
            later = (pose >= k)[:, None] * columns[:, :6]
            effects.append(Effect(MOVED, f"{board}, {labels[k]}", later, of_pose))
    every = np.sum(list(slopes.values()), axis=0)
    of_lens = (("zoom", Dimension.RATIO), *[("center", Dimension.PIXEL)] * 2)
    of_motion = of_lens[1:] + (("motion", Dimension.PIXEL),) * 2  # a shift, and more by each row
    for k in seen:
        of_picture = (pose == k)[:, None] * every
        effects.append(Effect(ZOOMED, labels[k], of_picture[:, 6:9], of_lens))
        effects.append(Effect(MOVING, labels[k], of_picture[:, 7:], of_motion))
    return effects


def _linearize_pictures(linear: FitLinearization) -> Iterator[tuple[int, Image, FloatArray]]:
    """Yield number, kind and whitened derivatives (r, 2, 11) of the rows of pictures by the pose of
    the board, a zoom, the center, and a motion [px] from the first to the last row of a picture
    that a rolling shutter reads row by row, at the fit.
    """
    poses, nuisance = linear.solution.linearized, linear.solution.nuisance
    if poses is None:
        return
    for number, rows in enumerate(r for r in linear.problem.rows if len(r.poses)):
        kind = rows.kind
        if not isinstance(kind, Image) or kind.sensed_joints:
            continue
        other = cast(Any, kind)
        other = replace(other, unknown=tuple(dict.fromkeys((*kind.own_items, *CHANGING))))
        now = np.zeros((1, 1, 0))
        if nuisance is not None and rows.nuisance.shape[1]:
            now = nuisance[:, rows.nuisance]
        parts = [
            other.stated_or_unknown(other.nominal_values, name)
            if (value := kind.item_values(now, name)) is None
            else value
            for name in other.own_items
        ]
        shape = now.shape[:2]
        values = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts]
        values = np.concatenate(values, axis=-1)
        derivative = other.evaluate(poses.T[:, rows.poses], rows.measured[:1], values).nuisance[0]
        by_board, by_focal, by_center = (other.item_values(derivative, n) for n in CHANGING)
        zoom = by_focal[..., :1] * other.item_values(values[0], "focal")[:, None, :1]
        height = rows.measured[0, :, 2, None, None] / kind.size[1] - 0.5
        columns = np.concatenate([by_board, zoom, by_center, height * np.eye(2)], axis=-1)
        yield number, kind, rows.whiten_columns(rows.whitener[:1], columns[None])[0]


def measure_picture_errors(
    linear: FitLinearization, explained: ExplainedResiduals
) -> list[Finding]:
    """Return the sizes of the errors of pictures that are among the causes of residuals."""
    rows = explained.rows
    of_pictures = (c for c in explained.causes if c.source in (MOVED, ZOOMED, MOVING))
    causes = [c for c in of_pictures if c.p_value <= DOUBTED]
    return [] if rows is None else [_measure(linear, rows, cause) for cause in causes]


def _measure(linear: FitLinearization, rows: ResidualRows, cause: Cause) -> Finding:
    """Return the size of an error as a finding."""
    effect = cause.effect
    assert effect is not None
    if len(effect.columns) != len(rows.residual):  # of a choice of the poses
        rows = rows.take_poses(linear.data)
    # the prediction lacks what is true of the pictures
    size = -np.linalg.lstsq(rows.project(effect.columns), rows.residual, rcond=1e-8)[0]
    robot = linear.fit.robot
    shared: dict[str, Any] = {"p_value": cause.p_value, "severity": cause.severity}
    if cause.source == MOVED:
        board, _, pose = cause.name.rpartition(", ")
        turn, shift = (float(np.linalg.norm(part)) for part in (size[:3], size[3:]))
        shown = {"turn": robot.to_quantity(turn, Dimension.ANGLE)}
        shown["shift"] = robot.to_quantity(shift, Dimension.LENGTH)
        return report_finding("residuals.board-moved", board=board, pose=pose, **shown, **shared)
    shared["pose"] = cause.name
    if cause.source == MOVING:
        motion = float(np.linalg.norm(size[2:]))
        return report_finding("residuals.moving-picture", motion=motion, **shared)
    zoom = 100.0 * float(size[0])
    return report_finding("residuals.zoomed-picture", zoom=zoom, **shared)


def find_print_scale(fit: Identification, data: Measurements) -> list[Finding]:
    """Return the scales at which boards are printed, where the parameters are farther from nominal
    than their spreads allow, and such scales explain it: another size of the board is another
    size of the machine.
    """
    changed, kinds = list[Observations](), dict[str, Image]()
    for rows in data.observations:
        kind = rows.kind
        if isinstance(kind, Image) and "print" not in kind.unknown:
            kinds[kind.board] = kind
            more = (*kind.unknown, "print")
            changed.append(replace(rows, kind=replace(cast(Any, kind), unknown=more)))
        else:
            changed.append(rows)
    if not kinds or not any(f.code in CONFLICT for f in fit.findings):
        return []
    try:
        other = identify(
            fit.initial, replace(data, observations=tuple(changed)), options=fit.options
        )
    except LoopcalError:
        return []
    if not other.converged or any(f.code in CONFLICT for f in other.findings):
        return []
    names, findings = list(other.nuisance.names), list[Finding]()
    for board in kinds:
        own = [i for i, name in enumerate(names) if f".{name}".endswith(f".{board}.scale_x")]
        for i in own[:1]:
            found, sd = other.nuisance.estimate[i : i + 2], other.nuisance.sd[i : i + 2]
            if (np.abs(found) > CLEAR * sd).any() and np.abs(found).max() > LEAST:
                x, y = (100.0 * (1.0 + float(scale)) for scale in found)
                named: dict[str, Any] = {"board": board, "scale_x": x, "scale_y": y}
                findings.append(report_finding("residuals.print-scale", **named))
    return findings


def report_picture_scale(robot: Mechanism, data: Measurements) -> list[Finding]:
    """Return what the lengths of a machine follow from where no reading, and no other instrument,
    measures a length: from the square of the board, or from nothing where its print is unknown.
    """
    kinds = [rows.kind for rows in data.all_observations if len(rows)]
    boards = [kind for kind in kinds if isinstance(kind, Image)]
    lengths = [actuator.dimension for actuator in robot.actuators]
    lengths += [column.dimension for kind in kinds for column in kind.columns]
    if not boards or Dimension.LENGTH in lengths:
        return []
    setup = data.nuisance_parameters.table
    free = {e.name for e in setup.entries if e.free and e.tolerance is None}
    names = tuple(dict.fromkeys(kind.board for kind in boards))
    is_known = not all(any(f".{n}".endswith(f".{b}.scale_x") for n in free) for b in names)
    severity = Severity.INFO if is_known else Severity.WARNING
    known: dict[str, Any] = {"boards": names, "is_known": is_known}
    return [report_finding("identifiability.board-scale", severity=severity, **known)]


def find_swapped_pictures(
    fit: Identification, data: Measurements, suspects: Sequence[str]
) -> list[Finding]:
    """Return which suspected pictures (labels of poses) show another pose: one at which their
    corners fit a calibration without all suspects.
    """
    suspected = np.isin(data.labels, suspects)
    if suspected.all() or not any(isinstance(o.kind, Image) for o in data.observations):
        return []
    try:
        without = identify(fit.initial, data.take(~suspected), options=fit.options)
    except LoopcalError:  # too few are left
        return []
    T, setup = forward(without.robot, data.readings).T, data.nuisance_parameters
    known = dict(zip(without.nuisance.names, without.nuisance.estimate.tolist(), strict=True))
    values = setup.values({name: known[name] for name in setup.table.names if name in known})
    findings = []
    for pose in np.flatnonzero(suspected).tolist():
        sizes = np.zeros(data.n_poses)
        count = 0
        for i, rows in enumerate(data.observations):
            own = np.flatnonzero((rows.rows == pose) & rows.is_measured)
            if not isinstance(rows.kind, Image) or rows.kind.sensed_joints or not len(own):
                continue
            of_own = setup.select(i, values[None])[:, own]
            at = np.broadcast_to(T[:, None], (len(T), len(own), 4, 4))
            residual = rows.kind.evaluate(at, rows.measured[None, own], of_own).residual
            white = rows.whitener[own] @ residual[..., None]
            sizes, count = sizes + (white**2).sum(axis=(1, 2, 3)), count + 2 * len(own)
        rms = np.sqrt(sizes / max(count, 1))
        shown = int(np.argmin(rms))
        if count and shown != pose and rms[shown] < SHOWN < rms[pose]:
            named: dict[str, Any] = {"pose": data.labels[pose], "shown": data.labels[shown]}
            findings.append(report_finding("outliers.swapped-picture", **named))
    return findings


# Probability of an effect by noise, above which no size is stated of an error of pictures, and
# travel, beside effects of the readings, is no cause.
DOUBTED = 0.1
# Measured values of a pose without which its errors have no pattern, such as single heights.
FEWEST_VALUES = 2

DRIVES, BACKLASH = "drives", "backlash"


@dataclass(frozen=True, eq=False)
class DriveErrors:
    """Errors of the readings that every pose has by itself.

    sigma : (a,) their standard deviations [SI]. findings : which errors, and the probability that
    independent errors of the instrument show them.
    """

    sigma: FloatArray
    findings: tuple[Finding, ...]

    def add_to_readings(self, data: Measurements) -> Measurements:
        """Return measurements with readings of these standard deviations."""
        return replace(data, reading_sigma=np.broadcast_to(self.sigma, data.readings.shape))

    def add_to(self, fit: Identification) -> Identification:
        """Return a fit with readings of these standard deviations, which says so."""
        posterior = replace(fit.posterior, reading_sigma=self.sigma)
        return replace(fit, posterior=posterior, findings=(*fit.findings, *self.findings))


def can_show_drives(linear: FitLinearization, rows: ResidualRows) -> bool:
    """Return whether rows of a fit with exact readings can show errors of the drives."""
    fit = linear.fit
    test = fit.residual_test  # with unknown sigmas, kinds of different noise show a pattern, too
    is_tested = fit.converged and test.intervals and test.noise == "given"
    is_plain = {fit.options.loss, fit.options.prior} == {None}
    is_plain &= linear.solution.linearized is not None  # the poses were kept
    return is_tested and is_plain and len(rows.residual) >= FEWEST_VALUES * linear.data.n_poses


def measure_drive_errors(
    linear: FitLinearization, explained: ExplainedResiduals
) -> DriveErrors | None:
    """Return the errors of the drives that cause residuals of a fit; None where none do."""
    rows, robot = explained.rows, linear.fit.robot
    causes = {c.source: c for c in explained.causes if c.source in (DRIVES, BACKLASH)}
    if rows is None or not causes:
        return None
    unit = list_units(linear)
    sigma, backlash, findings = np.zeros_like(unit), np.zeros_like(unit), []
    if (cause := causes.get(BACKLASH)) is not None:
        backlash, findings = _measure_backlash(linear, rows.take_poses(linear.data), cause)
    if (cause := causes.get(DRIVES)) is not None and cause.effect and cause.size:
        sigma = np.sqrt(cause.size.variance) * cause.effect.unit[0] * unit
        largest = int(np.argmax(sigma))
        size = robot.to_quantity(float(sigma[largest]), robot.actuators[largest].dimension)
        found = report_finding(
            "residuals.drive-errors", size=size, p_value=cause.p_value, severity=cause.severity
        )
        findings.append(found)
    return DriveErrors(np.hypot(sigma, backlash), tuple(findings)) if findings else None


def list_units(linear: FitLinearization) -> FloatArray:
    """Return the units (a,) [SI] in which errors of different drives count alike: lengths, and
    angles that turn the size of the robot by them.
    """
    robot = linear.fit.robot
    is_angle = [actuator.dimension is Dimension.ANGLE for actuator in robot.actuators]
    return np.where(is_angle, 1.0 / robot.size, 1.0)


def list_drive_effects(linear: FitLinearization, rows: ResidualRows) -> list[Effect]:
    """Return the effects of errors of each reading at each pose of the rows, of the direction in
    which it was approached, and cubic ones of its value, in the `list_units`; none where rows
    compare poses, or sense joints, which follow the readings in another way.
    """
    poses, states, robot = linear.solution.linearized, linear.solution.states, linear.fit.robot
    kinds = [r for r in linear.problem.rows if len(r.poses)]
    if any(r.kind.sensed_joints or r.kind.poses_per_row > 1 for r in kinds):
        return []
    assert poses is not None
    assert states is not None
    readings = linear.data.readings[None]
    S = differentiate_pose(robot, robot.values[None], readings, states.state).readings[0]
    values, places = np.zeros((len(rows.residual), S.shape[-1])), rows.locate_poses(linear.data)
    trials, same = np.zeros(1, np.int64), np.arange(len(S))
    for number, r in enumerate(kinds):
        own = rows.kind == number
        chosen, row = np.unique(rows.row[own], return_inverse=True)
        few = r.take_rows(chosen, same)
        evaluated, white = evaluate_rows(few, poses, trials, linear.solution.nuisance)
        Z = few.whiten_columns(white, evaluated.jacobian)[0] @ S[few.poses]
        values[own] = Z[row, rows.column[own]]
    values *= list_units(linear)
    chosen = statistics.find_distinct(places)
    of_poses = (places[:, None] == chosen)[:, :, None] * values[:, None, :]
    times = [o.context.get("time") for o in linear.data.observations if len(o)]
    is_alike = len(times) == 1 and len(linear.data.observations[0]) == len(S)
    order = order_by_time(times[0] if is_alike else None, len(S))
    direction = np.zeros_like(linear.data.readings)
    direction[order[1:]] = np.sign(np.diff(linear.data.readings[order], axis=0))
    x = np.apply_along_axis(scale_to_range, 0, linear.data.readings)
    along = np.concatenate([values * (x**k)[places] for k in (1, 2, 3)], axis=1)
    listed = {DRIVES: of_poses.reshape(len(values), -1), BACKLASH: values * direction[places]}
    label = (("reading", Dimension.LENGTH),)
    return [Effect(k, "", c, label * c.shape[1]) for k, c in (*listed.items(), (READING, along))]


def _measure_backlash(
    linear: FitLinearization, rows: ResidualRows, cause: Cause
) -> tuple[FloatArray, list[Finding]]:
    """Return half the backlash (a,) [SI] of each actuator that rows show, and the finding."""
    robot, unit = linear.fit.robot, list_units(linear)
    _, travel, along = list_drive_effects(linear, rows)
    # the direction of travel goes with the reading: a pose at an end was reached towards it
    known, effect = rows.with_effects(along.columns), travel.columns
    if test_effect(known, travel) > DOUBTED:
        return np.zeros(len(unit)), []
    if span_columns(SplitColumns.of(known.project(effect))).shape[1] < len(unit):
        return np.zeros(len(unit)), []
    half, *_ = np.linalg.lstsq(known.project(effect), known.residual, rcond=None)
    largest = int(np.argmax(np.abs(half)))
    actuator = robot.actuators[largest]
    size = robot.to_quantity(2.0 * float(abs(half[largest]) * unit[largest]), actuator.dimension)
    finding = report_finding(
        "residuals.backlash", name=actuator.name, size=size, p_value=cause.p_value,
        severity=cause.severity,
    )  # fmt: skip
    return np.abs(half) * unit, [finding]


NOISE, LARGER, OUTLIERS = "noise", "larger-noise", "outliers"
# Probability of noise alone below which a cause is named: as measured, this happens to
# `FALSE_ALARMS["causes of residuals"]` of clean data.
EXCLUDED = 0.08
LEAST_LEFT = 0.02  # share of the squares of an effect that must be left for it to be compared
OUTLYING = 0.1  # largest share of the poses that may be wrong
MOST_CAUSES, MOST_WRONG = 3, 30  # causes that are named, and wrong poses that are compared


def explain_residuals(linear: FitLinearization, *, is_doubted: bool = False) -> ExplainedResiduals:
    """Return the causes of the residuals of a fit, the most probable first; none where noise alone
    may explain them. `is_doubted` : whether another test found that it does not, so that wrong
    poses are among the causes from the beginning.
    """
    fit, data, rows = linear.fit, linear.data, collect_residual_rows(linear)
    if rows is None:
        return ExplainedResiduals(None)
    is_doubted |= fit.residual_test.exact_p_value < residual_test.DOUBT
    known = residual_test.count_sigma_degrees(
        fit.residual_test.noise, fit.options.sigma_uncertainty
    )
    poses = linear.solution.linearized
    T = forward(fit.robot, data.readings).T if poses is None else poses.T[0]
    tool = fit.robot.tool[:3, 3]
    of_place = describe_smooth_errors(T, tool, fit.robot.size, most=1, by_rotation=False)
    place = of_place.normalize(T)[:, 3:]

    def list_all(rows: ResidualRows) -> list[Effect]:
        """Return the effects of rows that these can show."""
        shared = list_shared_errors(rows, data, place)
        effects = [*list_effects(rows, data, fit.robot), *shared]
        return [effect for effect in effects if effect.columns.any()]

    few = rows.take_poses(data)
    effects = list_all(few)
    if can_show_drives(linear, rows):
        effects += list_drive_effects(linear, few)[:2]
    effects += list_picture_effects(linear, few)
    located = few.locate_poses(data)
    causes = compare_causes(few.remainder, effects, located, known, is_doubted=is_doubted)
    doubt = fit.residual_test.exact_p_value
    levels = [doubt, *[1.0] * len(causes)]  # the first explains what the noise does not
    causes = tuple(
        c._replace(severity=residual_test.choose_severity(min(c.p_value, level)))
        for c, level in zip(causes, levels, strict=False)
    )
    if few is not rows and causes:
        whole = {(effect.source, effect.name): effect for effect in list_all(rows)}
        causes = tuple(c._replace(effect=whole.get((c.source, c.name), c.effect)) for c in causes)
    return ExplainedResiduals(rows, causes)


def compare_causes(
    remainder: statistics.Remainder, effects: Sequence[Effect], pose: IntArray, known: float,
    *, is_doubted: bool = False,
) -> tuple[Cause, ...]:  # fmt: skip
    """Return the causes among effects and wrong poses; `pose` (R,) of each row. `known` degrees of
    freedom say that the noise has unit variance. Where it `is_doubted` by another test, the
    most probable of all is the first cause, and otherwise one is named once noise is excluded.
    """
    causes: list[Cause] = []
    listed = list(effects)
    alike = Counter(effect.source for effect in effects)
    while len(causes) < MOST_CAUSES and remainder.degrees >= residual_test.FEWEST_DEGREES:
        spectra = [remainder.find_spectrum(effect.scaled) for effect in listed]
        seen = [
            i
            for i, (effect, spectrum) in enumerate(zip(listed, spectra, strict=True))
            if spectrum.weights.sum() > LEAST_LEFT * (effect.scaled**2).sum()
        ]
        listed, spectra = [listed[i] for i in seen], [spectra[i] for i in seen]
        sizes = [spectrum.estimate(known) for spectrum in spectra]
        logs = [
            size.evidence - np.log(alike[e.source]) for size, e in zip(sizes, listed, strict=True)
        ]
        larger = _estimate_larger_noise(remainder, known) if known else -np.inf
        others = float(np.logaddexp.reduce([larger, *logs]))
        if not is_doubted and others < np.log(1.0 / EXCLUDED - 1.0):
            break
        wrong = measure_wrong_poses(remainder, pose, known)
        share = np.array([0.0, wrong, larger, *logs])
        share = np.exp(share - share.max())
        share /= share.sum()
        sources = [NOISE, OUTLIERS, LARGER, *(effect.source for effect in listed)]
        total = {name: float(share[[s == name for s in sources]].sum()) for name in sources}
        first, second, *_ = sorted(total, key=lambda name: -total[name])
        if share[0] > EXCLUDED and (causes or not is_doubted or first == NOISE):
            break
        stated = (total[first], second, total[second])
        best = int(np.argmax(np.where([s == first for s in sources], share, -1.0)))
        if first in (OUTLIERS, LARGER):
            causes.append(Cause(first, "", *stated, None, None, np.nan))
            if first == OUTLIERS:  # they have pulled the fit, so that the rest says nothing
                break
            known = 0.0
            continue
        effect = listed.pop(best - 3)
        spectrum, size = spectra[best - 3], sizes[best - 3]
        p_value = statistics.compute_any_probability(spectrum.compute_tail(known), len(effects))
        causes.append(Cause(first, effect.name, *stated, effect, size, p_value))
        if first == ZOOMED:  # it has pulled the fit, too
            break
        remainder = remainder.add(spectrum, size.ratio)
    return tuple(causes)


def _estimate_larger_noise(remainder: statistics.Remainder, known: float) -> float:
    """Return the evidence of a noise of unknown size beside the stated one."""
    square = float(remainder.residual @ remainder.weigh(remainder.residual))
    count = max(round(remainder.degrees), 1)
    y = np.full(count, np.sqrt(square / count))
    return statistics.estimate_variance_component(np.ones(count), y, known).evidence


def measure_wrong_poses(remainder: statistics.Remainder, pose: IntArray, known: float) -> float:
    """Return the evidence of few wrong poses; the worst one is excluded, and so on."""
    order = np.argsort(pose, kind="stable")
    names, count = np.unique(pose, return_counts=True)
    member = np.full((len(names), int(count.max())), -1)  # rows of each pose
    member[np.arange(member.shape[1]) < count[:, None]] = order
    is_row = member >= 0
    total, evidence = 0.0, [-np.inf]
    for k in range(1, min(max(int(OUTLYING * len(names)), 1), MOST_WRONG) + 1):
        square = float(remainder.residual @ remainder.weigh(remainder.residual))
        P = remainder.taken.toarray()[member] * is_row[..., None]
        own = remainder.weigh(remainder.residual)[member] * is_row
        w, vectors = np.linalg.eigh(
            is_row[:, None] * np.eye(member.shape[1]) - P @ P.swapaxes(1, 2)
        )
        y = (own[:, None] @ vectors)[:, 0]
        is_open = w > statistics.UNSEEN
        distance = (np.where(is_open, y, 0.0) ** 2 / np.where(is_open, w, 1.0)).sum(axis=1)
        degrees = is_open.sum(axis=1)
        left = remainder.degrees + known - degrees
        is_tested = (degrees > 0) & (left > 0.0)
        if not is_tested.any():
            break
        spread = np.ones(len(left))
        if not np.isinf(known):
            np.divide(square + known - distance, left, out=spread, where=is_tested)
        p_value = statistics.compute_f_tail(
            degrees, left, distance / np.maximum(degrees, 1) / spread
        )
        worst = int(np.argmin(np.where(is_tested, p_value, 2.0)))
        columns = np.zeros((len(pose), int(count[worst])))
        columns[member[worst, : count[worst]], np.arange(count[worst])] = 1.0
        spectrum = remainder.find_spectrum(columns)
        if not len(spectrum.y) or remainder.degrees <= len(spectrum.y):
            break
        total += spectrum.estimate(known).evidence - np.log((len(names) - k + 1) / k)
        remainder = remainder.add(spectrum, np.inf)
        evidence.append(total - k * np.log(2.0))  # more wrong poses are less probable
    return float(np.logaddexp.reduce(evidence))
