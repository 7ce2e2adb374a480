# SPDX-License-Identifier: Apache-2.0
"""Interpretations: other ways to read measurements, as pure functions from data to data.

An interpretation writes the values as the stated convention would write them, so that one
evaluation judges all interpretations. `value_interpretations` lists those of measured values,
`reading_interpretations` those of actuator readings; a combination applies two of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from loopcal.diagnose.conventions.changes import Change
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements

Slip = tuple[str, dict[str, Any], Change]
"""Kind of a slip, what is read differently, and how."""


@dataclass(frozen=True, eq=False)
class Interpretation:
    """One other way to read measurements.

    Attributes
    ----------
    slip : kind of the slip, such as `unit`; its code in the catalog is `conventions.<slip>`.
    details : what is read differently, such as quantity and factor.
    source : file or kind that it concerns; empty where it concerns all data.
    observation : index of the observations; None where the actuator readings are read differently.
    change : of the measured values, row by row, or of the readings of all poses.
    """

    slip: str
    details: Mapping[str, Any]
    source: str
    observation: int | None
    change: Change

    @property
    def parts(self) -> tuple[Interpretation, ...]:
        """The single interpretations that it consists of: itself."""
        return (self,)

    @property
    def shrinks(self) -> bool:
        """Whether values become smaller, so that they might no longer carry information."""
        return bool(self.details.get("factor", 1.0) < 1.0)

    @property
    def code(self) -> str:
        """Code of the slip in the catalog."""
        return f"conventions.{self.slip}"

    @property
    def finding(self) -> Finding:
        """The interpretation as a finding."""
        return report_finding(self.code, source=self.source, **self.details)

    def describe(self) -> dict[str, Any]:
        """Return code, source and details, for the data of another finding."""
        return {"code": self.code, "source": self.source, **self.details}

    def __repr__(self) -> str:
        return f"<Interpretation: {self.finding}>"

    def apply(self, data: Measurements) -> Measurements:
        """Return the measurements under this interpretation; covariances stay as stated."""
        if self.observation is None:
            return replace(data, readings=self.change(data.readings))
        observations = list(data.observations)
        rows = observations[self.observation]
        observations[self.observation] = replace(rows, measured=self.change(rows.measured))
        return replace(data, observations=tuple(observations))


@dataclass(frozen=True, eq=False)
class Combination(Interpretation):
    """Two interpretations, the first applied first; its `change` and `observation` are unused.

    Attributes
    ----------
    pair : the two.
    """

    pair: tuple[Interpretation, ...] = ()

    @property
    def parts(self) -> tuple[Interpretation, ...]:
        """The two interpretations."""
        return self.pair

    def apply(self, data: Measurements) -> Measurements:
        """Return the measurements under both interpretations."""
        for part in self.pair:
            data = part.apply(data)
        return data


def combine(first: Interpretation, second: Interpretation) -> Combination:
    """Return the combination of two interpretations."""
    details = {"parts": (first.describe(), second.describe())}
    return Combination("combination", details, "", None, second.change, (first, second))


def name_source(i: int, data: Measurements) -> str:
    """Return the source of an observation, such as a file, different from those of the others."""
    sources = [rows.source for rows in data.observations]
    if sources[i] and sources.count(sources[i]) == 1:
        return sources[i]
    return f"part {i + 1} of the data"
