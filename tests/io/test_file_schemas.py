# SPDX-License-Identifier: Apache-2.0
"""JSON Schemas accept every file that loopcal accepts, and refuse the mistakes that need no
numbers."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import loopcal as lc
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.exports.profile import list_shipped_profiles
from loopcal.io.file_schemas import build_profile_schema, build_robot_schema, build_settings_schema
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.studies.files.study_file import build_study_schema

ROOT = Path(__file__).parents[2]
STUDIES = sorted((ROOT / "examples" / "studies").glob("*.yaml"))
SCHEMAS = {
    "robot": build_robot_schema(),
    "settings": build_settings_schema(),
    "profile": build_profile_schema(),
    "study": build_study_schema(),
}


def list_faults(kind: str, content: Mapping[str, Any]) -> list[str]:
    validator = jsonschema.Draft202012Validator(SCHEMAS[kind])
    plain = {str(key): value for key, value in content.items()}
    return [error.message for error in validator.iter_errors(plain)]


def read(path: Path) -> Mapping[str, Any]:
    return read_yaml(path, "file").content


@pytest.mark.parametrize("kind", SCHEMAS)
def test_each_schema_is_valid_and_says_what_keys_mean(kind: str) -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMAS[kind])
    assert "description" in str(SCHEMAS[kind])


def test_the_schemas_accept_every_shipped_file() -> None:
    for path in (*list_shipped_robots().values(), *ROOT.glob("examples/*/truth.yaml")):
        assert not list_faults("robot", read(path)), path
    for path in list_shipped_profiles().values():
        assert not list_faults("profile", read(path)), path
    for path in STUDIES:
        assert not list_faults("study", read(path)), path


ROBOT_MISTAKES = {
    "an unknown key": {"colour": "red"},
    "a text in place of a number": {"home": {"z": "far"}},
    "an unknown family": {"family": "hexapods"},
    "an unknown unit": {"units": {"length": "mmm", "angle": "deg"}},
    "a list of wrong length": {"workspace": {"x": [1, 2, 3]}},
    "a nested unknown key": {"tool": {"xx": 1}},
    "a table row without a value": {"identified": [{"name": "leg1.length", "unit": "mm"}]},
}


@pytest.mark.parametrize("mistake", ROBOT_MISTAKES)
def test_the_schema_of_robots_refuses_what_the_reader_refuses(mistake: str, tmp_path: Path) -> None:
    content = {**read(list_shipped_robots()["hexapod-42"]), **ROBOT_MISTAKES[mistake]}
    assert list_faults("robot", content)
    path = tmp_path / "robot.yaml"
    path.write_text(json.dumps(content))  # JSON is YAML
    with pytest.raises(lc.FileError):
        lc.load_robot(path)


SETTINGS_CASES: list[tuple[bool, dict[str, Any]]] = [
    (True, {"kind": "position", "targets": ["SMR1"], "noise": {"*": "5 um"}, "session": "a"}),
    (True, {"kind": "component", "components": ["z"], "noise_source": "assumed"}),
    (False, {"kind": "positions"}),
    (False, {"kind": "position", "targets": 3}),
    (False, {"kind": "position", "sigma": "5 um"}),
]


@pytest.mark.parametrize(("is_good", "content"), SETTINGS_CASES)
def test_the_schema_of_settings_tells_good_from_wrong_ones(
    is_good: bool, content: dict[str, Any]
) -> None:
    assert (not list_faults("settings", content)) == is_good


@pytest.mark.parametrize(
    ("kind", "path", "mistake"),
    [
        ("profile", next(iter(list_shipped_profiles().values())), {"delimiter": "dash"}),
        ("profile", next(iter(list_shipped_profiles().values())), {"colums": {}}),
        ("study", STUDIES[0], {"replicates": "many"}),
        ("study", STUDIES[0], {"methods": {"a": {"methd": "map"}}}),
    ],
)
def test_the_other_schemas_refuse_mistakes(kind: str, path: Path, mistake: dict[str, Any]) -> None:
    assert list_faults(kind, {**read(path), **mistake})
