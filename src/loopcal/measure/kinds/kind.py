# SPDX-License-Identifier: Apache-2.0
"""What a kind of measurement is: columns, and a residual with its derivatives.

Adding a kind takes one file with one frozen dataclass, and its line in `KINDS`; files, templates,
documentation and the contract tests follow from what this class asks for. A kind knows nothing of
robots: it is given platform poses.

Shapes: t trials, r rows, c columns as written in files, m residuals (often c), u unknowns of the
kind, j joints it looks at. A kind with `poses_per_row` > 1 compares several poses in one row and has an
axis l for them: T (t, r, l, 4, 4), jacobian (t, r, l, m, 6). Values of unknowns are plain numbers
that add up; how a frame or a direction is written in them, see `loopcal.measure.kinds.parts`.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.numerics.decomposition import without_rounding
from loopcal.parameters import Parameter
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

Bools = BoolArray


@dataclass(frozen=True)
class Column:
    """A number in a row: its name in files, and what it measures."""

    name: str
    dimension: Dimension


class Evaluation(NamedTuple):
    """Residuals (predicted - measured) with their derivatives; rows and components not measured are
    zero in all three.

    Attributes
    ----------
    residual : (t, r, m) [SI]
    jacobian : (t, r, m, 6)
        By the platform twist (omega, v) in base axes; with an axis of links before m where there
        are several.
    nuisance : (t, r, m, u) or None
        By the kind's own unknowns, None where it has none.
    joints : (t, r, m, j) or None
        By the values of the joints it looks at, None where it looks at poses only.
    """

    residual: FloatArray
    jacobian: FloatArray
    nuisance: FloatArray | None = None
    joints: FloatArray | None = None


class Kind(ABC):
    """A kind of measurement with all that is fixed about it (frame, tool, form of orientation).

    Attributes
    ----------
    name : str
        As files and `KINDS` call it.
    poses_per_row : int
        How many poses one row compares.
    changes_with_pose : bool
        Whether columns that stay the same while the robot moves are a mistake; touched surfaces and
        locks stay at 0.
    description : str
        What is measured, for sentences that advise it with nothing unknown; "the" and the name
        where empty.
    """

    name: ClassVar[str]
    poses_per_row: ClassVar[int] = 1
    changes_with_pose: ClassVar[bool] = True
    description: ClassVar[str] = ""

    @property
    @abstractmethod
    def columns(self) -> tuple[Column, ...]:
        """The c columns of a row, as in files."""

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """The m numbers a noise or sigma is stated for; one for each residual."""
        return self.columns

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """The unknowns by what they describe (a frame, a target, a surface), in order."""
        return {}

    @property
    def nuisance_parameters(self) -> tuple[Parameter, ...]:
        """The u unknowns the kind brings with it, each with the scope that shares one value of it."""
        return tuple(parameter for part in self.setup_items.values() for parameter in part)

    @property
    def target_columns(self) -> Mapping[str, tuple[int, ...]]:
        """What is looked at, by name, with the places of its columns."""
        return {self.name: tuple(range(len(self.columns)))}

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """What unknowns of a name are counted from (a frame's stated orientation); kinds that share
        the name must agree.
        """
        return {}

    @property
    def sensed_joints(self) -> tuple[str, ...]:
        """Names of the j joints, driven or passive, whose values the residual depends on."""
        return ()

    @classmethod
    @abstractmethod
    def examples(cls) -> "tuple[Kind, ...]":
        """Instances that together show every setting; documentation, templates and contract tests
        use them.
        """

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """The kind for a robot with this tool (4, 4); the same object where the tool does not
        matter or is stated.
        """
        del T_platform_tool
        return self

    @property
    def has_tool(self) -> bool:
        """Whether the kind knows all it needs to be evaluated."""
        return True

    def detect_present(self, measured: FloatArray) -> Bools:
        """Which residuals (..., m) can be formed from columns (..., c); NaN stands for what was not
        measured.
        """
        return ~np.isnan(measured)

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Rows (index, sentence) of columns (r, c) that cannot mean what they say."""
        del measured
        return ()

    def evaluate(
        self,
        T: FloatArray,
        measured: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> Evaluation:
        """Residuals and derivatives at platform poses.

        Parameters
        ----------
        T : (t or 1, r, 4, 4)
            T_base_platform of each row (with an axis of links where there are several).
        measured : (t or 1, r, c) [SI]
            NaN where not measured.
        unknowns : (t or 1, r or 1, u), optional
            Values of the kind's unknowns that hold for each row; default: nominal.
        joints : (t, r, j), optional
            Values of the joints in `sensed_joints`.

        Returns
        -------
        Evaluation

        Raises
        ------
        DataError
            If the kind looks at joints and none are given.
        """
        if self.sensed_joints and joints is None:
            raise DataError(
                f"the kind {self.name!r} needs the values of {', '.join(self.sensed_joints)}; hand them "
                "over as joints"
            )
        filled = np.where(np.isnan(measured), self.placeholder, measured)
        values = self.values(unknowns)
        if len(values) > len(T):
            T = np.broadcast_to(T, (len(values), *T.shape[1:]))
        result = self._seen(
            self._evaluate(T, filled, values, np.empty((1, 1, 0)) if joints is None else joints)
        )
        present = self.detect_present(measured)
        if np.all(present):
            return result
        here = present[..., None]
        links = present[..., None, :, None] if self.poses_per_row > 1 else here
        own, moved = (
            None if part is None else np.where(here, part, 0.0)
            for part in (result.nuisance, result.joints)
        )
        return Evaluation(
            np.where(present, result.residual, 0.0),
            np.where(links, result.jacobian, 0.0),
            own,
            moved,
        )

    def _seen(self, found: Evaluation) -> Evaluation:
        """Derivatives by own unknowns with zeros where these cancel, as the place of a target does
        between parallel poses.

        They are compared with what a move of the platform does to the row. A metre stands beside a
        radian there: the limit lies so far below all that counts that any length of machines would
        do.
        """
        if found.nuisance is None:
            return found
        by_move = np.linalg.norm(found.jacobian, axis=-1)
        by_move = by_move.sum(axis=-2) if self.poses_per_row > 1 else by_move
        return found._replace(nuisance=without_rounding(found.nuisance, by_move[..., None]))

    @property
    def placeholder(self) -> FloatArray:
        """Columns (c,) that stand where nothing was measured, so that nothing becomes NaN."""
        return np.zeros(len(self.columns))

    @abstractmethod
    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        """`evaluate` with unknowns and measured values filled in; anything finite may come where
        nothing was measured.
        """

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Candidates (k, u) for the unknowns of rows that share them, from poses T (r, 4, 4) and
        columns (r, c) alone.

        Found in closed form where there is one; `loopcal.measure.initial_values` improves and
        compares them.
        """
        del T, measured
        return self.nominal_values[None]

    @abstractmethod
    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns that an instrument with this noise would write.

        Parameters
        ----------
        T : (t, r, 4, 4)
            True T_base_platform.
        noise : (t, r, m)
            In the noise columns.
        unknowns : (t or 1, r or 1, u), optional
        joints : (t, r, j), optional
            Default: zero.

        Returns
        -------
        measured : (t, r, c) [SI]
            With `evaluate(T, measured).residual = -linearize_noise(measured) noise` to first order.
        """

    def linearize_noise(self, measured: FloatArray) -> FloatArray:
        """Matrix (..., m, m) by which errors of the noise columns enter the residuals (up to sign)."""
        m = len(self.noise_columns)
        return np.broadcast_to(np.eye(m), (*measured.shape[:-1], m, m))

    # --- for the kinds themselves
    # ------------------------------------------------------------------------------------

    @property
    def nominal_values(self) -> FloatArray:
        """Nominal values (u,) of the unknowns."""
        return np.array([parameter.nominal for parameter in self.nuisance_parameters])

    def values(self, unknowns: FloatArray | None) -> FloatArray:
        """The values given, or the nominal ones (1, 1, u)."""
        return self.nominal_values[None, None] if unknowns is None else unknowns

    def item_values(self, values: FloatArray, name: str) -> FloatArray | None:
        """Values (.., w) of one part, None where it is known."""
        first = 0
        for part, parameters in self.setup_items.items():
            if part == name:
                return values[..., first : first + len(parameters)]
            first += len(parameters)
        return None

    def columns_of(self, blocks: Mapping[str, FloatArray], shape: tuple[int, ...]) -> FloatArray:
        """Put derivatives side by side: the twist, then every part of the unknowns, zeros where a
        block is missing.

        Parameters
        ----------
        blocks : part or "twist" -> (.., w)
        shape : tuple of int
            Leading axes of the result.

        Returns
        -------
        rows : (*shape, 6 + u)
        """
        widths = {"twist": 6} | {name: len(part) for name, part in self.setup_items.items()}
        return np.concatenate(
            [
                np.broadcast_to(blocks.get(name, np.zeros(w)), (*shape, w))
                for name, w in widths.items()
            ],
            axis=-1,
        )

    def split(self, residual: FloatArray, rows: FloatArray) -> Evaluation:
        """The evaluation of residuals (t, r, m) whose derivatives (t, r, m, 6 + u) stand side by
        side.
        """
        return Evaluation(residual, rows[..., :6], rows[..., 6:] if self.setup_items else None)


def chosen(unknown: tuple[str, ...], possible: tuple[str, ...], kind: str) -> tuple[str, ...]:
    """What a kind is told is unknown, as a tuple; DataError names what can be."""
    named = (unknown,) if isinstance(unknown, str) else tuple(unknown)
    for name in named:
        if name not in possible:
            raise DataError(
                f"{name!r} cannot be unknown in the kind {kind!r}; what can be is "
                f"{', '.join(possible)}"
            )
    return named
