# SPDX-License-Identifier: Apache-2.0
"""A corrected robot is written and read back from files of any style, with any names."""

import json
import re

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import (
    add_table,
    find_robot_file,
    format_reduced_robot,
    get_source,
    load_robot,
    save_robot,
)
from loopcal.io.runs.run_folder import load_run

FIVE_BAR = find_robot_file("five-bar").read_text()
CONTENT = parse_yaml(FIVE_BAR, "five-bar.yaml", "robot file").content
BODY = FIVE_BAR.rstrip("\n")
WITHOUT_SOURCE = BODY.replace("source: ours\n", "")

STYLES = {
    "no final newline": BODY,
    "comment without newline": f"{BODY}\n# the end",
    "comment behind the last value": f"{BODY} # the end",
    "indented": "".join(f"    {line}\n" for line in BODY.split("\n")),
    "document end": f"---\n{BODY}\n...",
    "literal without newline": f"{WITHOUT_SOURCE}\nsource: |\n  text",
    "literal that keeps its breaks": f"{WITHOUT_SOURCE}\nsource: |+\n  text\n\n\n",
    "JSON": json.dumps(CONTENT, indent=2),
    "JSON in one line": json.dumps(CONTENT),
    "flow": re.sub(r'"(\w+)":', r"\1:", json.dumps(CONTENT)) + " # the end",
    "Windows": "\ufeff" + FIVE_BAR.replace("\n", "\r\n"),
    "table in the middle": FIVE_BAR.replace("\nlimbs:", "\nidentified: []\n# limbs\nlimbs:"),
}


def write(path, text: str):
    path.write_bytes(text.encode())
    return path


@pytest.mark.slow
@pytest.mark.parametrize("text", STYLES.values(), ids=STYLES)
def test_robot_file_of_any_style_takes_the_identified_table(tmp_path, text: str) -> None:
    robot = load_robot(write(tmp_path / "robot.yaml", text))
    values = robot.values * (1 + 1e-3 * np.random.default_rng(7).uniform(size=len(robot.values)))
    save_robot(robot.with_values(values), tmp_path / "new.yaml", np.full(len(values), 1e-6))
    again = load_robot(tmp_path / "new.yaml")
    assert (np.abs(again.values - values) <= np.spacing(np.abs(values))).all()
    assert again.parameters == robot.parameters
    assert again.record.file.content.keys() - robot.record.file.content.keys() <= {"identified"}
    save_robot(again.nominal, tmp_path / "nominal.yaml")
    nominal = load_robot(tmp_path / "nominal.yaml")
    assert "identified" not in nominal.record.file.content
    assert np.array_equal(nominal.values, robot.parameters.nominal)
    reduced = format_reduced_robot(again, {robot.parameters.names[0]: "why # it is fixed"})
    (tmp_path / "reduced.yaml").write_text(reduced)
    assert not load_robot(tmp_path / "reduced.yaml").parameters.free[0]


@pytest.mark.parametrize("name", ["hexapod-42", "five-bar", "linear-delta"])
def test_the_identified_table_is_added_as_it_was_formatted(name: str) -> None:
    """The content that is stated beside the text is what YAML reads from the text: a candidate
    counts only where both agree, and otherwise the whole file is written anew.
    """
    robot = load_robot(name)
    n = len(robot.values)
    values = robot.values * (1 + 1e-3 * np.random.default_rng(7).uniform(size=n))
    values[0] = 0.0
    plus_minus = np.geomspace(1e-9, 1e3, n)
    plus_minus[-1] = np.inf
    changed = robot.with_values(values)
    text = get_source(robot).nominal_file.text
    added = add_table(get_source(robot).nominal_file, changed, plus_minus)
    assert added.text.startswith(text)
    assert parse_yaml(added.text, added.path, "robot file").content == added.content
    assert len(added.content["identified"]) >= robot.parameters.free.sum()


def test_windows_line_ends_are_kept(tmp_path) -> None:
    robot = load_robot(write(tmp_path / "robot.yaml", STYLES["Windows"]))
    save_robot(robot.with_values(robot.values * 1.1), tmp_path / "new.yaml")
    raw = (tmp_path / "new.yaml").read_bytes()
    assert raw.count(b"\n") == raw.count(b"\r\n") > 20


NAMES = (
    ("leg #1", "a, b", "x: y", '"q"'),
    ("*w", "%w", "yes", "1e3"),
    ("é - a", "{a}", "'", "null"),
    ("? a", "!q", "&q", "|"),
)


@pytest.mark.parametrize("names", NAMES, ids=str)
def test_names_of_limbs_and_actuators_pass_through_every_file(tmp_path, monkeypatch, names) -> None:
    monkeypatch.chdir(tmp_path)
    text = FIVE_BAR
    for word, name in zip(("left", "right", "west", "east"), names, strict=True):
        text = re.sub(rf"\b{word}\b", lambda _, n=name: json.dumps(n, ensure_ascii=False), text)
    (tmp_path / "robot.yaml").write_text(text)
    for command in (
        "simulate robot.yaml -o data.csv --draw 12 --kind position --draw-errors",
        "calibrate robot.yaml data.csv -o run --force",
        "export run -o values.json --force",
    ):
        assert main(command.split()) in (0, 2), command
    robot, run = load_robot("robot.yaml"), load_run("run")
    assert [actuator.name for actuator in run.robot.actuators] == list(names[:2])
    assert [limb.name for limb in run.robot.assembly.limbs] == list(names[2:])
    assert run.robot.parameters == robot.parameters
    assert load_measurements("data.csv", robot).n_poses == 12
