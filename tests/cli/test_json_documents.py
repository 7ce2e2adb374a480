# SPDX-License-Identifier: Apache-2.0
"""Every command prints with `--json` what `loopcal schema output` publishes, refusals included."""

import io
import json
import re

import jsonschema
import pytest

from loopcal.cli.commands.study_commands import study
from loopcal.cli.entry_point import SECTIONS
from tools import output_schema

SCHEMA = json.loads(output_schema.SCHEMA.read_text("utf-8"))
COMMANDS = [name for members in SECTIONS.values() for name in members if name != study.name]
COMMANDS += [f"{study.name} {name}" for name in study.commands]


def list_faults(name: str, document: dict) -> list[str]:
    whole = {**SCHEMA, "$ref": f"#/$defs/{name}"}
    errors = jsonschema.Draft202012Validator(whole).iter_errors(document)
    faults = [f"{name}: {error.message[:200]}" for error in errors]
    return faults + sorted(document.keys() - SCHEMA["$defs"][name]["properties"].keys())


def test_the_schema_is_one_and_has_every_command() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert {*COMMANDS, "error", "finding"} == SCHEMA["$defs"].keys()


@pytest.mark.slow
def test_documents_of_all_commands_follow_the_published_schema(tmp_path, monkeypatch) -> None:
    """New keys need `python -m tools.output_schema`; where a key vanishes, FORMAT grows, too."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    seen = set()
    for name, document in output_schema.run_commands():
        seen.add(name)
        if "$schema" not in document:
            assert not list_faults(name, document)
    assert seen == set(COMMANDS)


@pytest.mark.slow
def test_screens_of_all_commands_have_one_order(tmp_path, monkeypatch) -> None:
    """A sentence, then tables, and at most one next step; of a calibration first verdict and
    accuracy, then the errors, what was found, and what to do.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    seen = set()
    for name, screen in output_schema.print_commands():
        seen.add(name)
        lines = screen.strip().splitlines()
        tables = [i for i, line in enumerate(lines) if set(line) == {"─"}]
        steps = [i for i, line in enumerate(lines) if line.startswith("Next: ")]
        assert len(steps) <= 1, screen
        if tables:
            assert tables[0] >= 2, screen  # below a caption or a sentence, and the head
            assert not steps or tables[0] < steps[0], screen
        if name == "calibrate":
            sentences = [".*alibrated: |Undecided: ", "(Typical|Expected) error ", "Errors at "]
            if lines[0].startswith("Not "):
                del sentences[1]
            order = [next(i for i, x in enumerate(lines) if re.match(s, x)) for s in sentences]
            assert [0, *order, tables[0], steps[0]] == sorted([*order, 0, tables[0], steps[0]])
    assert seen == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("wrong", ["--no-such-option", "no-such-file no-such-file no-such-file"])
def test_refusals_of_all_commands_follow_the_published_schema(loopcal, name, wrong) -> None:
    document = loopcal(f"{name} {wrong} --json", code=1).json
    assert not list_faults("error", document)
    assert document["error"]["type"] != "TypeError"


def test_a_refused_file_has_a_type_to_branch_on_where_it_has_no_code(loopcal, tmp_path) -> None:
    (tmp_path / "bad.csv").write_text("# kind: position\npose,q1 [mm]\n1,x\n")
    error = loopcal("calibrate linear-delta bad.csv --json", code=1).json["error"]
    assert (error["type"], error["code"]) == ("FileError", None)
