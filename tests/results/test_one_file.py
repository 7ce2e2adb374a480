# SPDX-License-Identifier: Apache-2.0
"""A number is added to a result in one place: everything that shows or stores it follows."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from numpy.testing import assert_array_equal

from loopcal.io.core.text_file import to_json
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.presenters import register
from loopcal.results.result import DrawnResult
from loopcal.results.serialization import restore_numbers
from loopcal.results.storage import restore, restore_arrays, store_arrays
from loopcal.results.tables import render_text
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Backlash(DrawnResult):
    """Backlash of joints. `worst` is the new number: one property and one line of `FIELDS`."""

    joints: tuple[str, ...]
    gap: FloatArray
    limit: float | None = None

    @property
    def worst(self) -> FloatArray:
        """(n,) twice the gap [m]."""
        return 2.0 * self.gap

    FIELDS = (
        *fields("joints", "limit"),
        Field("gap", axes="joint", unit="m", key="gap", is_stored=True),
        Field("worst", axes="joint", unit="m", key="worst"),
    )
    LABELS = label_axes(joint="joints")
    CAPTION = "Backlash"

    def __str__(self) -> str:
        return f"{len(self.joints)} joints"


RESULT = Backlash(("elbow", "wrist"), np.array([1e-5, np.inf]))


def test_text_and_html_have_the_number() -> None:
    text = render_text(RESULT.page(), 80)
    assert "worst [m]" in text
    assert "2e-05" in text
    assert '<td class="numbers">2e-05</td>' in RESULT._repr_html_()


def test_pandas_and_xarray_have_the_number_with_its_unit() -> None:
    assert list(RESULT.to_frame().columns) == ["joint", "gap [m]", "worst [m]"]
    data = RESULT.to_dataset()
    assert data["worst"].sel(joint="elbow") == 2e-5
    assert data["worst"].attrs["units"] == "m"


def test_json_has_the_number_and_is_read_back() -> None:
    content = json.loads(to_json(RESULT.to_dict()))
    assert content["worst"] == [2e-5, None]
    again = restore(Backlash, restore_numbers(content))
    assert again.joints == RESULT.joints
    assert again.limit is None
    assert_array_equal(again.worst, RESULT.worst)


def test_arrays_are_stored_and_read_back() -> None:
    stored = store_arrays(RESULT, "backlash_")
    assert list(stored) == ["backlash_gap"]
    again = restore_arrays(Backlash, stored, "backlash_", joints=RESULT.joints)
    assert again is not None
    assert_array_equal(again.gap, RESULT.gap)
    assert restore_arrays(Backlash, {}, "backlash_", joints=RESULT.joints) is None


def test_a_registered_figure_is_drawn() -> None:
    register("figure", Backlash)(lambda result: ("figure of", result))
    assert RESULT.plot() == ("figure of", RESULT)
