# SPDX-License-Identifier: Apache-2.0
"""docs/files.md and docs/exports.md describe what the code reads and writes."""

import json
import re

import pytest

from loopcal.cli.entry_point import main
from loopcal.io.robot import robot_file as reference
from loopcal.measure.kinds import KINDS
from loopcal.mechanism.families import FAMILIES
from loopcal.mechanism.families.linear_delta import LinearDelta
from tools import file_reference
from tools.markdown import find_blocks

PAGE = file_reference.PAGE.read_text("utf-8")


def test_pages_are_up_to_date() -> None:
    assert file_reference.fill_page(PAGE) == PAGE, "run `make docs`"
    assert {m["name"] for m in find_blocks(PAGE, file_reference.BLOCK)} == set(
        file_reference.BLOCKS
    )
    exports = file_reference.EXPORTS.read_text("utf-8")
    assert file_reference.fill_page(exports) == exports, "run `make docs`"
    assert {m["name"] for m in find_blocks(exports, file_reference.BLOCK)} == set(
        file_reference.EXPORT_BLOCKS
    )


def test_every_family_and_kind_has_a_section() -> None:
    for name in FAMILIES:
        assert f"### `family: {name}`\n" in PAGE
    for name in KINDS:
        assert f"### `kind: {name}`\n" in PAGE


def test_pages_count_kinds_and_shipped_robots(root) -> None:
    changes = (root / "CHANGELOG.md").read_text("utf-8")
    assert f"| {len(KINDS)} [kinds]" in changes
    assert f"| {len(reference.list_shipped_robots())} shipped [robots]" in changes
    assert f"| {len(KINDS)} kinds, mixed" in (root / "docs" / "coming-from.md").read_text("utf-8")


def test_keys_have_type_default_and_description() -> None:
    found = {key.name: key for key in reference.list_keys(LinearDelta)}
    assert found["radius"] == reference.Key(
        "radius", "length", "0", "horizontal distance of a rod's ends with the nozzle in the center"
    )
    assert found["readings"].holds == "`drop` or `height`"
    assert found["arms"].holds == "length or list of length"
    assert found["name"].default == "needed"


def test_every_key_of_a_run_folder_is_described(tmp_path, monkeypatch, root) -> None:
    monkeypatch.chdir(root / "examples" / "hexapod-42")
    assert (
        main(
            [
                "calibrate",
                "hexapod-42",
                "measurements.csv",
                "-o",
                str(tmp_path / "run"),
                "--hold-out",
                "0.25",
            ]
        )
        == 0
    )
    result = json.loads((tmp_path / "run" / "result.json").read_text(), parse_constant=pytest.fail)
    described = set(re.findall(r"`(\w+)`", PAGE[PAGE.index("## Run folders") :]))
    keys = set(result) - {"nulls"}
    for part in ("made_by", "fit", "start", "split", "validation"):
        keys |= set(result[part])
    keys |= set(result["fit"]["parameters"][0]) | set(result["validation"]["before"])
    assert sorted(keys - described) == []
