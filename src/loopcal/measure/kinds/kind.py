# SPDX-License-Identifier: Apache-2.0
"""What a kind of measurement is: columns, and a residual with its derivatives.

Adding a kind takes one file with one frozen dataclass, and its line in `KINDS`; files, templates, documentation and the
contract tests follow from what this class asks for. A kind knows nothing of robots: it is given platform poses.

Shapes: t trials, r rows, c columns as written in files, m residuals (often c), u unknowns of the kind. A kind with
`links` > 1 compares several poses in one row and has an axis l for them: T (t, r, l, 4, 4), jacobian (t, r, l, m, 6).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from loopcal.parameters import Parameter
from loopcal.units import Dimension

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Column:
    """A number in a row: its name in files, and what it measures."""

    name: str
    dimension: Dimension


class Evaluation(NamedTuple):
    """Residuals (predicted - measured) with their derivatives; rows and components not measured are zero in all three.

    Attributes
    ----------
    residual : (t, r, m) [SI]
    jacobian : (t, r, m, 6)
        By the platform twist (omega, v) in base axes; with an axis of links before m where there are several.
    own : (t, r, m, u) or None
        By the kind's own unknowns, None where it has none.
    """

    residual: Array
    jacobian: Array
    own: Array | None = None


class Kind(ABC):
    """A kind of measurement with all that is fixed about it (frame, tool, form of orientation).

    Attributes
    ----------
    name : str
        As files and `KINDS` call it.
    links : int
        How many poses one row compares.
    """

    name: ClassVar[str]
    links: ClassVar[int] = 1

    @property
    @abstractmethod
    def columns(self) -> tuple[Column, ...]:
        """The c columns of a row, as in files."""

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """The m numbers a noise or sigma is stated for; one for each residual."""
        return self.columns

    @property
    def unknowns(self) -> tuple[Parameter, ...]:
        """The u unknowns the kind brings with it, each with the scope that shares one value of it."""
        return ()

    @classmethod
    @abstractmethod
    def examples(cls) -> "tuple[Kind, ...]":
        """Instances that together show every setting; documentation, templates and contract tests use them."""

    def mounted(self, T_platform_tool: Array) -> Self:
        """The kind for a robot with this tool (4, 4); the same object where the tool does not matter or is stated."""
        del T_platform_tool
        return self

    @property
    def is_mounted(self) -> bool:
        """Whether the kind knows all it needs to be evaluated."""
        return True

    def present(self, measured: Array) -> Bools:
        """Which residuals (..., m) can be formed from columns (..., c); NaN stands for what was not measured."""
        return ~np.isnan(measured)

    def doubts(self, measured: Array) -> tuple[tuple[int, str], ...]:
        """Rows (index, sentence) of columns (r, c) that cannot mean what they say."""
        del measured
        return ()

    def evaluate(self, T: Array, measured: Array, unknowns: Array | None = None) -> Evaluation:
        """Residuals and derivatives at platform poses.

        Parameters
        ----------
        T : (t, r, 4, 4)
            T_base_platform of each row (with an axis of links where there are several).
        measured : (t or 1, r, c) [SI]
            NaN where not measured.
        unknowns : (t or 1, r, u), optional
            Values of the kind's unknowns that hold for each row.

        Returns
        -------
        Evaluation
        """
        result = self._evaluate(T, measured, unknowns)
        present = self.present(measured)
        if np.all(present):
            return result
        links = present[..., None, :, None] if self.links > 1 else present[..., None]
        own = None if result.own is None else np.where(present[..., None], result.own, 0.0)
        return Evaluation(np.where(present, result.residual, 0.0), np.where(links, result.jacobian, 0.0), own)

    @abstractmethod
    def _evaluate(self, T: Array, measured: Array, unknowns: Array | None) -> Evaluation:
        """`evaluate`, free to put anything finite where a component is not measured."""

    @abstractmethod
    def measure(self, T: Array, noise: Array, unknowns: Array | None = None) -> Array:
        """Columns that an instrument with this noise would write.

        Parameters
        ----------
        T : (t, r, 4, 4)
            True T_base_platform.
        noise : (t, r, m)
            In the noise columns.
        unknowns : (t or 1, r, u), optional

        Returns
        -------
        measured : (t, r, c) [SI]
            With `evaluate(T, measured).residual = -noise_map(measured) noise` to first order.
        """

    def noise_map(self, measured: Array) -> Array:
        """Matrix (..., m, m) by which errors of the noise columns enter the residuals (up to sign)."""
        m = len(self.noise_columns)
        return np.broadcast_to(np.eye(m), (*measured.shape[:-1], m, m))
