# SPDX-License-Identifier: Apache-2.0
"""Errors of measured heights over x and y, before and after calibration.

A printer owner sees a wrong geometry as a bowl or a tilted plane on the bed. Such a map is made of
a platform that translates in x, y and z and does not rotate: elsewhere the errors of a height
depend on more than its place. Rows that measure one height (the component z of the tool, or the gap
to a level plane) have an error, prediction minus measurement, and a place x, y: where the
calibrated geometry has the touching point at the recorded readings. Of a height that a firmware
reported, the error before calibration is that height itself: positive where the bed seems too high.

"Before" is the baseline of `loopcal.apply.validation`: the geometry before calibration with the
setup parameters that fit it best at the fitted rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from loopcal.diagnose import row_errors
from loopcal.errors import DataError
from loopcal.estimate.residual_test import DOUBT
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import compute_f_tail
from loopcal.results.description import Field, fields
from loopcal.results.result import DrawnResult
from loopcal.results.storage import restore_arrays
from loopcal.results.tables import to_quantity
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension, Unit

SHIFT_UNDECIDED, TILT_UNDECIDED = "workflow.height-shift", "workflow.height-tilt"
PREFIX = "heights_"  # beginning of the names of the stored arrays
FEWEST = 3  # heights that show a plane; with fewer there is no map
LEVEL = 0.2  # largest ratio of the points' range in z to that in x, y of a level surface
# Freedoms of a platform over whose x and y heights are mapped.
TRANSLATIONS = tuple(AXES.index(axis) for axis in "xyz")
# Mean height [m], and its ratio to the scatter, from which a wrong zero of the probe is as
# probable as a wrong machine.
SHIFTED, SHIFT_RATIO = 1e-3, 3.0
AS_LARGE = 2.0  # ratio of variances of residuals up to which two causes explain them alike
STEEP = 3e-3  # tilt [rad] of a bed, 0.45 mm over 150 mm, from which parts are visibly skewed
LEAST_SHARE = 0.1  # least share of a tilted plane in the squares of heights that is reported
UPRIGHT = 0.95  # least cosine of the angle between the z axes of the measured frame and of the base


@dataclass(frozen=True, eq=False, repr=False)
class HeightErrors(DrawnResult):
    """Errors of n measured heights, prediction minus measurement, at their places x, y.

    Attributes
    ----------
    poses : (n,) labels. points : (n, 2) x, y of the touching point by the calibrated geometry, in
        the base frame of the robot file [m]. before, after : (n,) errors [m].
    is_held_out : (n,) whether a height was held out of the fit. unit : in which all are shown.
    """

    poses: tuple[str, ...]
    points: FloatArray
    before: FloatArray
    after: FloatArray
    is_held_out: BoolArray
    unit: Unit

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("poses", is_stored=True),
        Field("points", is_stored=True),
        Field("pose", "poses", "row"),
        Field("x", lambda heights: heights.points[:, 0], "row", "m"),
        Field("y", lambda heights: heights.points[:, 1], "row", "m"),
        Field("before", axes="row", unit="m", key="before", is_stored=True),
        Field("after", axes="row", unit="m", key="after", is_stored=True),
        Field("held_out", "is_held_out", "row", key="held_out", is_stored=True),
        *fields(
            statistics=lambda heights: {
                name: {e: heights.statistics(e, is_held_out) for e in ("before", "after")}
                for name, is_held_out in heights.list_sets()
            }
        ),
    )

    def statistics(self, errors: str, held_out: bool) -> row_errors.Statistics:
        """Return the error statistics "before" or "after" of held-out or fitted heights [m]."""
        return row_errors.compute_statistics(
            np.abs(getattr(self, errors)[self.is_held_out == held_out])
        )

    def report_alternatives(self, count: int) -> list[Finding]:
        """Return the wrong zero of the probe, and the tilted bed, that heights cannot tell apart
        from errors of the machine; `count` : number of fitted parameters.

        A plane a + b x + c y is fitted to the errors before calibration. It explains all heights as
        well as the calibration does where its variance is no larger: neither by the F test of the
        other parameters, nor by the factor `AS_LARGE`, which few degrees of freedom do not show.
        """
        n, before = len(self.poses), self.before
        mean, scatter, findings = float(before.mean()), float(before.std()), list[Finding]()
        if abs(mean) > max(SHIFTED, SHIFT_RATIO * scatter):
            shift, rest = (to_quantity(length, self.unit) for length in (mean, scatter))
            findings.append(report_finding(SHIFT_UNDECIDED, shift=shift, rest=rest))
        centered = self.points - self.points.mean(axis=0)
        slope, _, rank, _ = np.linalg.lstsq(centered, before - mean)
        left = float(((before - mean - centered @ slope) ** 2).sum())
        own, more, degrees = float((self.after**2).sum()), count - FEWEST, n - count
        share = 1.0 - left / (n * scatter**2 or 1.0)
        if rank < 2 or more < 1 or degrees < 1 or not own or share < LEAST_SHARE:
            return findings
        gain = max(left - own, 0.0)  # prior knowledge may leave more than a plane does
        is_as_large = left / (n - FEWEST) <= AS_LARGE * own / degrees
        tail = float(compute_f_tail(more, degrees, gain / more / (own / degrees)))
        tilt = float(np.linalg.norm(slope))
        alone = tilt > STEEP and is_as_large and tail > DOUBT
        data: dict[str, Any] = {"tilt": Quantity(1e3 * tilt, "mrad"), "share": share}
        data["alone"] = alone
        return [*findings, report_finding(TILT_UNDECIDED, **data)]

    def list_sets(self) -> Iterator[tuple[str, bool]]:
        """Yield "fitted" and "held-out" with whether they are held out, as far as there are any."""
        for name, is_held_out in (("fitted", False), ("held-out", True)):
            if (self.is_held_out == is_held_out).any():
                yield name, is_held_out


def map_height_errors(
    fit: Identification, fitted: Measurements, held_out: Measurements | None
) -> HeightErrors | None:
    """Return the errors of all heights; None where the data measure no heights, the platform
    rotates or does not move in x, y and z, or a geometry does not reach the poses.

    fit : that converged. fitted, held_out : the measurements of the calibration.
    """
    if not has_height_map(fit.robot):
        return None
    listed = []
    for data, is_held_out in ((fitted, False), (held_out, True)):
        if data is None or not any(_measures_height(o) for o in data.observations):
            continue
        try:
            compared = row_errors.compare_predictions(
                fit.initial, fit.robot, data, fit.nuisance.starts, fit.nuisance.values
            )
        except DataError:  # the validation reports that no pose is reached
            continue
        listed += [(*heights, is_held_out) for heights in _list_heights(compared, fit.robot)]
    unit = fit.robot.get_unit(Dimension.LENGTH)
    if sum(len(labels) for labels, *_ in listed) < FEWEST:
        return None
    labels, points, before, after, is_held_out = zip(*listed, strict=True)
    return HeightErrors(
        tuple(label for of_kind in labels for label in of_kind),
        np.concatenate(points),
        np.concatenate(before),
        np.concatenate(after),
        np.repeat(np.array(is_held_out, dtype=bool), [len(of_kind) for of_kind in labels]),
        unit,
    )


def has_height_map(robot: Mechanism) -> bool:
    """Return whether the platform translates in x, y and z and does not rotate."""
    return robot.program.freedoms == TRANSLATIONS


def restore_heights(arrays: Mapping[str, np.ndarray], robot: Mechanism) -> HeightErrors | None:
    """Return stored errors; None where a run has none, or its robot has no map of heights."""
    if not has_height_map(robot):
        return None
    return restore_arrays(HeightErrors, arrays, PREFIX, unit=robot.get_unit(Dimension.LENGTH))


def measures_only_heights(data: Measurements) -> bool:
    """Return whether each row of the data measures one height, and nothing else was measured."""
    return bool(data.observations) and all(_measures_height(o) for o in data.observations)


def _measures_height(rows: Observations) -> bool:
    """Return whether each row measures one height: z of the tool, or the gap of one target."""
    kind = rows.kind
    if rows.measured.shape[1] != 1:  # asked first: most data need no import of these two kinds
        return False
    if isinstance(kind, Component):
        return kind.components == ("z",) and bool(kind.T_base_frame[2, 2] > UPRIGHT)
    return isinstance(kind, Plane) and len(kind.targets) == 1


def _list_heights(
    compared: row_errors.PredictionComparison, robot: Mechanism
) -> Iterator[tuple[tuple[str, ...], FloatArray, FloatArray, FloatArray]]:
    """Yield labels, places (r, 2) and errors (r,) before and after of each kind of heights."""
    rows = compared.data.observations
    before, after = compared.before.residuals(rows), compared.after.residuals(rows)
    for i, o in enumerate(rows):
        if not _measures_height(o):
            continue
        # the tool or target as stated
        kind, place = o.kind, robot.tool[:3, 3]
        if isinstance(kind, Component) and kind.T_platform_tool is not None:
            place = kind.T_platform_tool[:3, 3]
        if isinstance(kind, Plane) and kind.places is not None:
            place = kind.places[0]
        T = compared.after.T[0, o.rows.reshape(len(o))]
        points = T[:, :3, :3] @ place + T[:, :3, 3]
        extent = np.ptp(points, axis=0)
        if isinstance(kind, Plane) and extent[2] > LEVEL * extent[:2].max():
            continue  # a wall
        labels = tuple(compared.data.labels[k] for k in o.rows.reshape(len(o)))
        yield labels, points[:, :2], before[i][:, 0], after[i][:, 0]
