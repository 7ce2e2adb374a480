# SPDX-License-Identifier: Apache-2.0
"""Errors of pictures of a board, among the causes of residuals: a board that moved, a picture with
another focal length, a board that is printed at another scale, and a picture of another pose.

Each is a cause of few sizes: six of a board from a pose on, zoom and center of a picture, the two
scales of a print. They are compared with errors of any size in all corners of a picture
(`loopcal.diagnose.error_causes`). See docs/theory/camera.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from loopcal.diagnose.residual_patterns import Cause, Effect, ExplainedResiduals, ResidualRows
from loopcal.errors import LoopcalError
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.identification import identify
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure.kinds.image import Image
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.numerics.statistics import choose_evenly
from loopcal.typing import FloatArray
from loopcal.units import Dimension

MOVED, ZOOMED = "moved-board", "zoomed-picture"
CHANGING = ("board", "focal", "center")  # items of a kind that these errors change
STEPS = 24  # poses, evenly chosen, from which on a board may be elsewhere
CLEAR, LEAST = 6.0, 0.002  # standard deviations, and size, from which a scale is named
CONFLICT = ("prior.tolerances-inflated", "prior.tolerances-too-narrow")
SHOWN = 3.0  # residuals in sigmas (rms) up to which a picture shows another pose
SIZES = (("rotation", Dimension.ANGLE), ("position", Dimension.LENGTH))


def list_picture_effects(linear: FitLinearization, rows: ResidualRows) -> list[Effect]:
    """Return the effects of errors of pictures on the whitened rows; none without pictures."""
    slopes: dict[str, FloatArray] = {}  # board -> (R, 9) by pose, zoom and center
    for number, kind, of_kind in _linearize_pictures(linear):
        own = np.flatnonzero(rows.kind == number)
        columns = slopes.setdefault(kind.board, np.zeros((len(rows.residual), 9)))
        columns[own] = of_kind[rows.row[own], rows.column[own]]
    if not slopes:
        return []
    pose, labels = rows.locate_poses(linear.data), linear.data.labels
    seen = np.unique(pose[np.any(list(slopes.values()), axis=(0, 2))])
    of_pose, effects = (*[SIZES[0]] * 3, *[SIZES[1]] * 3), list[Effect]()
    for board, columns in slopes.items():
        for k in seen[choose_evenly(len(seen), STEPS)][1:]:
            later = (pose >= k)[:, None] * columns[:, :6]
            effects.append(Effect(MOVED, f"{board}, {labels[k]}", later, of_pose))
    every = np.sum(list(slopes.values()), axis=0)
    of_lens = (("zoom", Dimension.RATIO), *[("center", Dimension.PIXEL)] * 2)
    for k in seen:
        of_picture = (pose == k)[:, None] * every[:, 6:]
        effects.append(Effect(ZOOMED, labels[k], of_picture, of_lens))
    return effects


def _linearize_pictures(linear: FitLinearization) -> Iterator[tuple[int, Image, FloatArray]]:
    """Yield number, kind and whitened derivatives (r, 2, 9) of the rows of pictures by the pose of
    the board, a zoom and the center, at the fit.
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
        focal = other.item_values(values[0], "focal")[:, None]
        zoom = (by_focal * focal).sum(axis=-1, keepdims=True)
        columns = np.concatenate([by_board, zoom, by_center], axis=-1)
        yield number, kind, rows.whiten_columns(rows.whitener[:1], columns[None])[0]


def measure_picture_errors(
    linear: FitLinearization, explained: ExplainedResiduals
) -> list[Finding]:
    """Return the sizes of the errors of pictures that are among the causes of residuals."""
    rows = explained.rows
    causes = [c for c in explained.causes if c.source in (MOVED, ZOOMED)]
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
    zoom = 100.0 * float(size[0])
    return report_finding("residuals.zoomed-picture", pose=cause.name, zoom=zoom, **shared)


def find_print_scale(fit: Identification, data: Measurements) -> list[Finding]:
    """Return the scales at which boards are printed, where the parameters are farther from nominal
    than their tolerances allow, and such scales explain it: another size of the board is another
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
    return [
        report_finding(
            "identifiability.board-scale", severity=severity, boards=names, is_known=is_known
        )
    ]


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
