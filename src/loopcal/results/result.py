# SPDX-License-Identifier: Apache-2.0
"""Bases of results: text, JSON, pages of notebooks, tables of pandas and xarray, and figures.

A result states its fields once, see `loopcal.results.description`. Nothing here knows a result.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from loopcal.environment import import_optional
from loopcal.findings import Finding, Severity
from loopcal.plain_text import represent
from loopcal.results.description import Field, Records, Source, collect_records
from loopcal.results.presenters import draw, find_presenter
from loopcal.results.serialization import json_fields

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from loopcal.results.tables import Block, Table


UNBROKEN = 1_000_000  # characters of a line that no text has


class Result:
    """Base of results that notebooks show as text and tables."""

    FIELDS: ClassVar[tuple[Field, ...]] = ()
    """What the result states. Without fields for JSON, JSON has the fields of the dataclass."""

    @property
    def failures(self) -> tuple[Finding, ...]:
        """Findings by which the result is not good enough, such as limits that are exceeded."""
        findings: tuple[Finding, ...] = getattr(self, "findings", ())
        return tuple(f for f in findings if f.severity is Severity.FAILURE)

    def to_dict(self) -> dict[str, Any]:
        """Return the content by name for JSON, SI."""
        return json_fields(self)

    def page(self) -> list[Block]:
        """Return what a notebook shows: paragraphs and tables."""
        return [str(self)]

    def __str__(self) -> str:
        """Return the registered page as text, without one the findings, one on each line.

        A result without a page and without findings is its fields.
        """
        from loopcal.results.tables import render_text

        own_page = find_presenter("page", type(self))
        if own_page is not None:
            return render_text(own_page(self), UNBROKEN)
        stated = getattr(self, "findings", ()) or (
            getattr(self, "finding", None) or represent(self),
        )
        return "\n".join(map(str, stated))

    def __repr__(self) -> str:  # of dataclasses with `repr=False`, which have a text or a page
        return str(self)

    def _repr_html_(self) -> str:
        """Return the result as HTML, with at most some 30 rows of each table."""
        from loopcal.results.notebook import render_html

        own_page = find_presenter("page", type(self))
        return render_html(self.page() if own_page is None else own_page(self))


class TableResult(Result):
    """Base of results with numbers for pandas and xarray: fields with axes."""

    LABELS: ClassVar[Mapping[str, Source | Sequence[Any]]] = {}
    """Axis -> names along it, or their source; numbers from 1 for others."""

    CAPTION: ClassVar[str] = ""
    """Caption of the main table in notebooks."""

    def list_fields(self) -> Iterable[Field]:
        """Return the fields; a class whose arrays depend on its content overrides this."""
        return self.FIELDS

    def list_labels(self) -> Mapping[str, Source | Sequence[Any]]:
        """Return `LABELS`; a class whose axes depend on its content overrides this."""
        return self.LABELS

    def records(self) -> Records:
        """Return the arrays with their units and dimensions."""
        return collect_records(self, tuple(self.list_fields()), self.list_labels())

    def page(self) -> list[Block]:
        """Return what a notebook shows: the text and the main table."""
        return [str(self), self.main_table()]

    def main_table(self) -> Table:
        """Return the fields along the first axis as a table; of many columns the first."""
        from loopcal.results.notebook import build_main_table

        return build_main_table(self.records(), self.CAPTION)

    def to_frame(self) -> Any:
        """Return the main table as a pandas DataFrame; headings state the units.

        MissingPackageError : pandas is not installed.
        """
        return import_optional("pandas", "tables").DataFrame(self.records().list_columns())

    def to_dataset(self) -> Any:
        """Return the arrays as an xarray Dataset; the attribute `units` of each states its unit.

        MissingPackageError : xarray is not installed.
        """
        from loopcal.results.notebook import build_dataset

        return build_dataset(self.records())


class DrawnResult(TableResult):
    """Base of results with a figure, which is registered."""

    def plot(self) -> Figure:
        """Draw the result."""
        return draw(self)
