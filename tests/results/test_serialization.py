# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from loopcal.findings import Finding, Quantity, Severity
from loopcal.results.description import fields
from loopcal.results.serialization import INFINITE, UNDEFINED, json_fields, to_json
from loopcal.units import Dimension


class Status(IntEnum):
    CONVERGED = 0


@dataclass(frozen=True)
class Record:
    rank: int = 3
    sd: np.ndarray = field(default_factory=lambda: np.array([1.0, np.inf, np.nan]))
    _cache: object = None


@dataclass(frozen=True)
class WithTable:
    FIELDS: ClassVar = fields(rank="inner.rank", status="")
    inner: Record = field(default_factory=Record)
    status: Status = Status.CONVERGED


@dataclass(frozen=True)
class WithMethod:
    a: float = 1.0

    def to_dict(self) -> dict[str, object]:
        return {**json_fields(self), "twice": 2.0 * self.a}


def test_dataclasses_arrays_enums_paths_and_mappings_are_written_as_json():
    document = {
        "inner": Record(),
        Dimension.LENGTH: (np.float64(0.5), np.int64(2), np.bool_(True)),
        "where": Path("a/b"),
        "nothing": None,
    }
    nulls: dict[str, str] = {}
    written = to_json(document, nulls)
    assert written == {
        "inner": {"rank": 3, "sd": [1.0, None, None]},
        "length": [0.5, 2, True],
        "where": "a/b",
        "nothing": None,
    }
    assert nulls == {"inner/sd/1": INFINITE, "inner/sd/2": UNDEFINED}
    json.dumps(written, allow_nan=False)


def test_json_keys_come_from_a_table_or_a_method_of_the_class():
    assert to_json(WithTable()) == {"rank": 3, "status": "converged"}
    assert to_json([WithMethod(2.0)]) == [{"a": 2.0, "twice": 4.0}]


def test_quantities_and_severities_are_written_as_json():
    assert to_json(Quantity(0.19, "mm")) == {"value": 0.19, "unit": "mm"}
    assert to_json(Severity.WARNING) == "warning"
    assert set(Finding.__dataclass_fields__) == {"code", "severity", "data"}


def test_value_without_a_json_form_is_refused_with_its_path():
    with pytest.raises(TypeError, match="parts/1: complex"):
        to_json({"parts": [1.0, 2.0 + 1.0j]})
