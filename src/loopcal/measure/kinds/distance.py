# SPDX-License-Identifier: Apache-2.0
"""Kind `distance`: from a fixed point to points of the platform, by a wire, an interferometer or a
ballbar.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.arrays import stored
from loopcal.measure.closed_form import FLAT, trilateration
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Column
from loopcal.measure.kinds.target import TargetKind, length_of, offset_of, points_of
from loopcal.measure.kinds.tool import stacked
from loopcal.parameters import Parameter
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class Distance(TargetKind):
    """Distance to a fixed point c. Residual: `|x - c| + offset - measured`, with slope `(x - c) /
    |x - c|`.

    Parameters
    ----------
    anchor : (3,) [m]
        The fixed point in the frame. Where unknown, the value it is counted from.
    anchor_name : str
        Its name; kinds that name the same one share its unknowns.
    Others: see `TargetKind`; "anchor", "targets" and "offset" (the zero of a wire) may be unknown.

    Raises
    ------
    DataError
        As `TargetKind`.
    """

    anchor: FloatArray = field(default_factory=lambda: np.zeros(3))
    anchor_name: str = "anchor"

    name: ClassVar[str] = "distance"
    per_target: ClassVar[tuple[Column, ...]] = (Column("distance", Dimension.LENGTH),)
    allowed_unknown: ClassVar[tuple[str, ...]] = ("anchor", "targets", "offset")

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "anchor", stored(self.anchor, "the anchor", (3,)))

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """A known point, an unknown one with a wire of unknown zero, and two unknown targets."""
        far = np.array([1.5, -0.8, 1.1])
        pair = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])
        return (
            cls(anchor=far),
            cls(anchor=far, unknown=("anchor", "offset"), anchor_name="wire1"),
            cls(targets=("a", "b"), places=pair, anchor=far, unknown=("targets", "anchor")),
        )

    def own_item(self, name: str) -> tuple[Parameter, ...]:
        """Three unknowns of the fixed point, one of the offset."""
        return (
            parts.point_part(self.anchor_name, self.anchor)
            if name == "anchor"
            else self.offset_part()
        )

    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """Distances (.., k, 1) and unit vectors."""
        own = self.item_values(values, "anchor")
        offset, blocks = offset_of(self, values)
        reach = x - (self.anchor if own is None else own[..., None, :])
        length, unit = length_of(reach)
        unit = unit[..., None, :]
        if own is not None:
            blocks["anchor"] = -unit
        return length + offset, unit, blocks

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Rows with a distance that is none."""
        return not_above_zero(measured)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """The fixed point by trilateration, targets where they are stated.

        Raises
        ------
        DataError
            If all points lie in a plane and nothing is said of the side on which the fixed point
            is.
        """
        _, _, points, seen = points_of(self, T, measured)
        if "anchor" not in self.unknown or len(seen) < 4:
            return self.nominal_values[None]
        inside = (points - self.T_base_frame[:3, 3]) @ self.T_base_frame[:3, :3]
        with_offset = "offset" in self.unknown
        found = [
            trilateration(inside, seen[:, 0], with_offset=flag) for flag in {False, with_offset}
        ]
        centres, offsets = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
        side = self._sides(inside, centres)
        return stacked(
            self,
            {"anchor": centres[side], "offset": offsets[side, None]},
            int(np.count_nonzero(side)),
        )

    def _sides(self, points: FloatArray, centres: FloatArray) -> BoolArray:
        """Which centres (k,) are on the stated side of a plane that all points (q, 3) lie in; all,
        if there is none.
        """
        middle = points.mean(axis=0)
        _, s, axes = np.linalg.svd(points - middle, full_matrices=False)
        if s[2] > FLAT * s[0] or "targets" in self.unknown:
            return np.ones(len(centres), dtype=bool)
        stated = (self.anchor - middle) @ axes[2]
        if not self.anchor.any() or abs(stated) <= FLAT * s[0]:
            raise DataError(
                f"the distances to {self.anchor_name!r} were all measured in one plane, so it can "
                "be on either side of it;"
                " state 'anchor' roughly where it is, or measure poses off the plane"
            )
        return (centres - middle) @ axes[2] * stated >= 0.0


def not_above_zero(measured: FloatArray) -> tuple[tuple[int, str], ...]:
    """Rows (index, sentence) of distances (r, c) that are zero or negative."""
    wrong = np.argwhere(measured <= 0.0)
    sentence = "has a distance of {:.6g} m; a distance is above 0, so correct it, or leave the cell empty where nothing was read"
    return tuple((int(i), sentence.format(measured[i, j])) for i, j in wrong)
