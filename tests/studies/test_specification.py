# SPDX-License-Identifier: Apache-2.0
"""Study files, keys of blocks, and damaged study files, whose errors name the line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from loopcal.errors import FileError
from loopcal.studies.files.study_file import load_study
from loopcal.studies.simulation.block import compute_block, list_tasks
from loopcal.studies.specification import (
    EffectsLevel,
    ErrorsLevel,
    MethodLevel,
    NoiseLevel,
    Outliers,
    PosesLevel,
    Scores,
    Study,
)
from tests.studies.studies import CAMERA, compute_block_key, make_study, read_robot

EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "studies").glob("*.yaml"))

TEXT = """\
format: 1
title: Which instrument suffices?
seed: 5
replicates: 130
block: 20
robots: [linear-delta, five-bar]
instruments:
  camera:
    kinds: [component]
    components: [x, y]
    sigma_position: 20 um
  gauge: {kinds: [component], components: [x], sigma_position: 3 um}
noise: [1, 2.5]
poses:
  20: {count: 20}
  best: {count: 20, choice: planned}
errors:
  small: 0.5
  set 1:
    deviations: {"*.length": 0.1 mm}
methods:
  - map
  - least-squares
effects:
  none: {}
  wrong: {outliers: {share: 0.1}, drift: 50 um}
scores: {held_out: 8, frame: base}
questions:
  poses: {factor: noise, score: position, limit: 30 um, share: 0.9}
quick: {replicates: 20, noise: 1}
"""


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a study file and returns its path."""

    def write_text(text: str) -> Path:
        path = tmp_path / "study.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write_text


def test_a_study_file_is_read_in_si(write):
    study = load_study(write(TEXT.replace("  20:", '  "20":')))
    assert (study.seed, study.replicates, study.block, study.blocks) == (5, 130, 20, 7)
    camera = study.instruments["camera"]
    assert camera.sigma_position == pytest.approx(2e-5)
    assert (camera.kinds, camera.components) == (("component",), ("x", "y"))
    assert study.noise == {"1": NoiseLevel(1.0), "2.5": NoiseLevel(2.5)}
    assert study.poses["best"] == PosesLevel(20, "planned")
    assert study.errors["small"] == ErrorsLevel(0.5)
    assert study.errors["set 1"].deviations == {"*.length": "0.1 mm"}
    assert list(study.methods) == ["map", "least-squares"]
    assert study.effects["wrong"].outliers == Outliers(0.1)
    assert study.effects["wrong"].drift == pytest.approx(5e-5)
    assert study.scores == Scores(8, "base")
    assert study.questions["poses"].limit == "30 um"
    assert len(study.cells) == 2 * 2 * 2 * 2 * 2 * 2 * 2
    assert study.cells[1].levels["effects"] == "wrong"  # the last factor varies fastest
    assert study.cells[1].levels["robot"] == "linear-delta"
    assert study.varied_factors[0] == "robot"
    assert study.count_trials(5) == 20
    assert study.count_trials(6) == 10


def test_the_quick_tier_replaces_settings_and_factors(write):
    path = write(TEXT.replace("  20:", '  "20":'))
    study = load_study(path, quick=True)
    assert (study.replicates, list(study.noise)) == (20, ["1"])
    full = load_study(path)
    assert replace(study, replicates=130, noise=full.noise) == full
    short = load_study(write(TEXT.replace("  20:", '  "20":').replace("quick:", "# ")), quick=True)
    assert short == replace(full, replicates=20)  # one block


def test_the_documented_study_is_read(write):
    page = (Path(__file__).parents[2] / "docs" / "files.md").read_text("utf-8")
    text = page.split("## Study files")[1].split("```yaml\n")[1].split("```")[0]
    study = load_study(write(text), quick=True)
    assert (len(study.cells), study.replicates) == (8, 50)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_shipped_studies_are_read(path):
    study, quick = load_study(path), load_study(path, quick=True)
    assert quick.replicates * len(quick.cells) <= 600
    assert study.replicates > quick.replicates
    assert Study.from_json(study.to_json()) == study


def test_robots_are_shipped_ones_or_files_beside_the_study(write, tmp_path):
    robot = read_robot("five-bar").text
    (tmp_path / "mine.yaml").write_text(robot, encoding="utf-8")
    study = load_study(write("format: 1\ntitle: t\nrobots: {shop: mine.yaml, other: five-bar}\n"))
    assert study.robots["shop"].text == study.robots["other"].text == robot
    assert study.robots["shop"].source == "mine.yaml"


def test_common_errors_have_no_smallest_size(write, tmp_path):
    text = read_robot("rotary-delta").text
    common = "{name: batch of rods, of: [arm*.length], length: {sd: 0.6}}"
    (tmp_path / "mine.yaml").write_text(f"{text}\ncommon_errors:\n  - {common}\n")
    study = "format: 1\ntitle: t\nrobots: [mine.yaml]\nerrors:\n  e: {distribution: uniform}\n"
    assert load_study(write(study)).errors["e"].distribution == "uniform"
    with pytest.raises(FileError, match=r"study.yaml:5: .*in common.*Remove 'smallest'"):
        load_study(write(study.replace("uniform}", "uniform, smallest: 0.5}")))


def test_poses_may_be_those_of_a_file(write, tmp_path):
    poses = "pose,x [mm],y [mm],z [mm]\na,10,20,30\nb,-10,5,40\n"
    (tmp_path / "poses.csv").write_text(poses, encoding="utf-8")
    text = "format: 1\ntitle: t\nrobots: [linear-delta]\nposes: {mine: {file: poses.csv}}\n"
    study = load_study(write(text))
    level = study.poses["mine"]
    assert level.count == 2
    assert json.loads(next(list_tasks(study)).content)["measured"] == [
        list(c) for c in level.coordinates
    ]
    (tmp_path / "poses.csv").rename(tmp_path / "others.csv")
    renamed = load_study(write(text.replace("poses.csv", "others.csv")))
    assert list_keys(renamed) == list_keys(study)
    for old, new, words in (
        ("poses.csv", "none.csv", "lacks"),
        ("poses.csv", "others.csv, count: 3", "no other setting"),
        ("file: poses.csv", "coordinates: [[0.0, 0.0, 0.0]]", "a file gives the poses"),
        ("file: poses.csv", "file: 3", "must be text"),
    ):
        with pytest.raises(FileError, match=words) as caught:
            load_study(write(text.replace(old, new)))
        assert caught.value.line == 4
    robots = text.replace("poses.csv", "others.csv").replace("linear-delta", "hexapod-42")
    with pytest.raises(FileError, match=r"4: cannot read the poses: .*others\.csv"):
        load_study(write(robots))


def test_a_study_is_the_same_after_json():
    study = make_study(effects={"e": EffectsLevel(outliers=Outliers(0.1), drift=1e-5)})
    assert Study.from_json(study.to_json()) == study


# --- keys


def list_keys(study: Study) -> list[str]:
    """Return the keys of all blocks."""
    return [compute_block_key(study, cell, b) for cell in study.cells for b in range(study.blocks)]


CHANGES = {
    "seed": {"seed": 4},
    "block": {"block": 7},
    "robot": {"robots": {"linear-delta": read_robot("linear-delta-6")}},
    "instrument": {"instruments": {"camera": replace(CAMERA, sigma_position=3e-5)}},
    "noise": {"noise": {"1": NoiseLevel(1.1)}},
    "poses": {"poses": {"12": PosesLevel(13)}},
    "choice": {"poses": {"12": PosesLevel(12, "planned")}},
    "errors": {"errors": {"1": ErrorsLevel(error_factor=2.0)}},
    "method": {"methods": {"least squares": MethodLevel("map")}},
    "effects": {"effects": {"none": EffectsLevel(correlation=0.5)}},
    "scores": {"scores": Scores(held_out=6)},
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_key_changes_with_what_determines_the_numbers(change):
    study = make_study()
    assert set(list_keys(study)).isdisjoint(list_keys(replace(study, **CHANGES[change])))


def test_a_key_does_not_change_with_anything_else():
    study = make_study(replicates=18)
    keys = list_keys(study)
    assert len(set(keys)) == 3
    assert list_keys(replace(study, title="another")) == keys
    assert list_keys(replace(study, order=("method", "poses"))) == keys
    assert list_keys(replace(study, replicates=15)) == keys
    assert list_keys(replace(study, replicates=24))[:3] == keys
    renamed = replace(study, methods={"LS": MethodLevel("least-squares")})
    assert list_keys(renamed) == keys
    further = replace(study, poses={"5": PosesLevel(5), **study.poses})
    assert list_keys(further)[3:] == keys
    sourced = {"delta": replace(read_robot("linear-delta"), source="robots/delta.yaml")}
    assert list_keys(replace(study, robots=sourced)) == keys


def test_tasks_are_those_of_the_chosen_cells_and_blocks():
    study = make_study(replicates=18, poses={"12": PosesLevel(12), "15": PosesLevel(15)})
    tasks = list(list_tasks(study))
    assert [(task.cell, task.block) for task in tasks] == [(c, b) for c in (0, 1) for b in range(3)]
    assert [task.key for task in tasks] == list_keys(study)
    assert list(list_tasks(study, [1], [2, 0])) == [tasks[5], tasks[3]]


def test_the_content_of_a_task_is_all_that_a_block_needs():
    (task,) = list_tasks(make_study())
    content = json.dumps(json.loads(task.content), sort_keys=True)  # another layout
    again = compute_block(replace(task, cell=99, content=content))
    assert again.tobytes() == compute_block(task).tobytes()


# --- damaged files

DAMAGES = {
    "no format": ("format: 1\n", "", None, "format: 1"),
    "newer": ("format: 1", "format: 7", 1, "newer loopcal"),
    "no title": ("title: Which instrument suffices?\n", "", None, "'title'"),
    "unknown key": ("seed: 5", "sead: 5", 3, "'seed'"),
    "seed": ("seed: 5", "seed: -5", 3, "'seed' is -5"),
    "replicates": ("replicates: 130", "replicates: 0", 4, "'replicates' is 0"),
    "decimal": ("replicates: 130", "replicates: 13.5", 4, "must be a whole number"),
    "exponent": ("replicates: 130", "replicates: 1e3", 4, "without decimal point or exponent"),
    "no robot": ("robots: [linear-delta, five-bar]\n", "", None, "robots: [hexapod-42]"),
    "wrong robot": ("five-bar]", "five-baar]", 6, "five-bar"),
    "outside": ("five-bar]", "../robot.yaml]", 6, "folder"),
    "no level": ("robots: [linear-delta, five-bar]", "robots: []", 6, "at least one"),
    "same level": ("[1, 2.5]", "[1, 1]", 13, "two levels"),
    "kind": ("kinds: [component]\n", "kinds: [componend]\n", 8, "component"),
    "component": ("components: [x, y]\n", "components: [x, q]\n", 8, "'q'"),
    "no unit": ("sigma_position: 20 um", "sigma_position: 20", 11, "no unit"),
    "wrong unit": ("sigma_position: 20 um", "sigma_position: 20 deg", 11, "length"),
    "unknown setting": ("sigma_position: 20 um", "sigma_pos: 20 um", 11, "sigma_position"),
    "not positive": ("sigma_position: 20 um", "sigma_position: 0 um", 11, "above 0"),
    "plain instrument": ("  gauge: {kinds: [component], components: [x], sigma_position: 3 um}",
                         "  gauge: pose", 12, "must have settings"),
    "noise": ("[1, 2.5]", "[1, -2]", 13, "above 0"),
    "text noise": ("[1, 2.5]", "[1, two]", 13, "must be a number"),
    "count": ("count: 20}\n  best", "count: 0}\n  best", 15, "count' is 0"),
    "choice": ("choice: planned", "choice: plannd", 16, "'planned'"),
    "parameter": ('"*.length"', '"*.lenght"', 19, "no parameter"),
    "dimension": ("0.1 mm", "0.1 deg", 19, "length"),
    "method": ("- map", "- mapp", 22, "'map'"),
    "share": ("share: 0.1}", "share: 1.1}", 26, "from 0 to 1"),
    "nested": ("outliers: {share", "outliers: {part", 26, "share, size"),
    "drift": ("drift: 50 um", "drift: 50", 26, "no unit"),
    "frame": ("frame: base", "frame: world", 27, "'base'"),
    "held out": ("held_out: 8", "held_out: 0", 27, "held_out' is 0"),
    "limit": ("scores: {held_out: 8", "scores: {limit_position: 1 mm", 27, "verdict: true"),
    "factor": ("factor: noise", "factor: noize", 29, "noise"),
    "no order": ("factor: noise", "factor: method", 29, "no order"),
    "score": ("score: position", "score: positoin", 29, "position"),
    "limit unit": ("limit: 30 um", "limit: 30 deg", 29, "length"),
    "quick": ("quick: {replicates: 20", "quick: {replicate: 20", 30, "replicates"),
    "quick title": ("quick: {replicates: 20", "quick: {title: a", 30, "'title'"),
    "quick level": ("noise: 1}", "noise: -1}", 30, "above 0"),
    "quick list": ("quick: {replicates: 20, noise: 1}", "quick: 20", 30, "must contain"),
}  # fmt: skip
"""Damage -> text, what replaces it, line of the error, words of the error."""


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGES)
def test_errors_name_the_line(write, damage):
    old, new, line, words = DAMAGES[damage]
    text = TEXT.replace("  20:", '  "20":')
    assert text.count(old) == 1
    path = write(text.replace(old, new))
    with pytest.raises(FileError) as caught:
        load_study(path)
    assert caught.value.line == line
    assert words in str(caught.value)


def test_a_lost_line_is_refused_unless_what_remains_is_another_study(write):
    lines = TEXT.replace("  20:", '  "20":').splitlines(keepends=True)
    whole, refused = load_study(write("".join(lines))), []
    for i in range(0, len(lines), 2):  # the others take as long again
        try:
            study = load_study(write("".join(lines[:i] + lines[i + 1 :])))
        except FileError:
            refused.append(lines[i].split(":")[0].strip())
        else:
            assert study != whole, lines[i]
    assert refused == ["format", "instruments", "kinds", "errors", "set 1", "methods", "poses"]
