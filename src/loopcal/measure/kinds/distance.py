# SPDX-License-Identifier: Apache-2.0
"""Kind `distance`: from a fixed point to points of the platform, by a wire, an interferometer or a
ball bar.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.geometry import FLATNESS, solve_trilateration
from loopcal.measure.array_checks import check_point
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import (
    BIAS,
    Column,
    Evaluation,
    InvalidRows,
    checked,
    list_rows,
    name_shared_error,
)
from loopcal.measure.kinds.position import Prediction, TargetKind
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class LengthKind(TargetKind):
    """A kind with one length above 0 for each target, and the offset of a session: its bias."""

    bias_item: ClassVar[str] = "offset"

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Also the offset of all readings."""
        name = name_shared_error(self, BIAS, "")
        offset = Parameter(name, Dimension.LENGTH, 0.0, scope="session")
        return {**super().possible_setup, "offset": setup.SetupItem((offset,))}

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return lengths of vectors x (.., k, 3) plus the offset."""
        length, unit = measure_lengths(x)
        offset = self.stated_or_unknown(values, "offset")
        return length + offset[..., None, :], unit[..., None, :], {"offset": np.ones((1, 1, 1))}

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows with a length that is not above zero."""
        return list_rows(
            np.any(measured <= 0.0, axis=1),
            lambda i: (
                f"has a distance of {measured[i][measured[i] <= 0.0][0]:.6g} m. A distance is "
                "above 0: correct it, or leave the cell empty if you measured nothing"
            ),
        )


def measure_lengths(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lengths (.., 1) of vectors (.., 3) and unit vectors, zero where a length is 0."""
    square = np.sum(x * x, axis=-1, keepdims=True)
    safe = np.sqrt(np.where(square > 0.0, square, 1.0))
    return np.where(square > 0.0, safe, 0.0), x / safe


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Distance(LengthKind):
    """Distance to a fixed point c. Residual: `|x - c| + offset - measured`, with slope `(x - c) /
    |x - c|`.

    Setup parameters [m]: `anchor.x` to `anchor.z`, `target.x` to `target.z` of each target, and
    `distance.offset`, with the name of `frame` or `anchor_name` where these are stated.

    Parameters
    ----------
    anchor : (3,) [m], the fixed point in the frame. If the anchor is unknown, its nominal value.
    anchor_name : name of the fixed point. Kinds that use the same name share its parameters.
    Others : see `TargetKind`; "anchor", "targets" and "offset" (the zero of a wire) may be unknown.

    Raises
    ------
    DataError : as `TargetKind`.
    """

    anchor: FloatArray = checked(check_point, "the anchor", np.zeros(3))
    anchor_name: str = "anchor"

    name: ClassVar[str] = "distance"
    per_target: ClassVar[tuple[Column, ...]] = (Column("distance", Dimension.LENGTH),)
    allowed_unknown: ClassVar[tuple[str, ...]] = ("anchor", "targets", "offset")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known point, an unknown one with a wire of unknown zero, and two targets."""
        far = np.array([1.5, -0.8, 1.1])
        pair = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])
        return (
            cls(anchor=far),
            cls(anchor=far, unknown=("anchor", "offset"), anchor_name="wire1"),
            cls(targets=("a", "b"), places=pair, anchor=far, unknown=("targets", "anchor")),
        )

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Also the fixed point."""
        anchor = setup.make_points_item((self.anchor_name,), self.anchor[None])
        return {**super().possible_setup, "anchor": anchor}

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return distances (.., k, 1) and unit vectors."""
        anchor = self.stated_or_unknown(values, "anchor")
        distance, unit, by_item = super().predict(x - anchor[..., None, :], values)
        return distance, unit, {**by_item, "anchor": -unit}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the fixed point by trilateration, with the targets at their stated places;
        DataError where all points are coplanar, and the stated anchor is on neither side.
        """
        _, _, points, distances = self.collect_points(T, measured)
        if "anchor" not in self.unknown or len(distances) < 4 or self.is_of_base:
            return self.nominal_values[None]
        inside = self.to_frame(points)
        with_offset = "offset" in self.unknown
        solutions = [
            solve_trilateration(inside, distances[:, 0], with_offset=flag)
            for flag in {False, with_offset}
        ]
        centers, offsets = (np.concatenate(arrays) for arrays in zip(*solutions, strict=True))
        middle = inside.mean(axis=0)
        _, s, axes = np.linalg.svd(inside - middle, full_matrices=False)
        if s[2] <= FLATNESS * s[0] and "targets" not in self.unknown:
            stated = (self.anchor - middle) @ axes[2]
            if not self.anchor.any() or abs(stated) <= FLATNESS * s[0]:
                raise DataError(
                    f"all distances to {self.anchor_name!r} begin at points of one "
                    "plane, so it can be on either side of that plane. Give an approximate "
                    "'anchor', or measure poses off the plane"
                )
            side = (centers - middle) @ axes[2] * stated >= 0.0
            centers, offsets = centers[side], offsets[side]
        return self.assemble_values({"anchor": centers, "offset": offsets[:, None]})


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Separation(LengthKind):
    """Distance of each target between two poses, by a ball bar or by calipers on a printed part.
    Residual: `|x_2 - x_1| + offset - measured`.

    A row names two poses. The frame does not matter.

    Setup parameters [m]: `target.x` to `target.z` of each target, and `separation.offset`.

    Parameters
    ----------
    See `TargetKind`; "targets" and "offset" (the zero of the calipers, the width of a printed
    line) may be unknown.
    """

    name: ClassVar[str] = "separation"
    poses_per_row: ClassVar[int] = 2
    description: ClassVar[str] = (
        "distances between two poses (ball bar; calipers on a printed part)"
    )
    per_target: ClassVar[tuple[Column, ...]] = (Column("separation", Dimension.LENGTH),)
    allowed_unknown: ClassVar[tuple[str, ...]] = ("targets", "offset")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return the tool's point, and an unknown point with an unknown zero."""
        return (cls(), cls(targets=("nozzle",), unknown=("targets", "offset")))

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        x, rows = self.locate_targets(T, values[..., None, :])
        predicted, unit, by_item = self.predict(x[..., 1, :, :] - x[..., 0, :, :], values)
        by_pose = unit[..., None, :, :, :] @ rows * np.array([-1.0, 1.0])[:, None, None, None]
        total = np.sum(by_pose, axis=-4) + self.join_columns(by_item, predicted.shape)
        evaluation = self.split_columns(predicted[..., 0], total[..., 0, :])
        return evaluation._replace(jacobian=by_pose[..., 0, :6])
