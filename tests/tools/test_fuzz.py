# SPDX-License-Identifier: Apache-2.0
"""The fuzzer: inputs follow from their seed alone, and every command and option has its turn."""

import json
import os
import subprocess
import sys
from random import Random

import pytest

from loopcal.cli.commands.study_commands import study
from loopcal.studies.files.store import NAME, StoreHeader, make_store
from tools.fuzz.campaign import join_ranges
from tools.fuzz.cases import Case, Maker
from tools.fuzz.commands import describe, draw_options, list_commands, name_command
from tools.fuzz.corpus import build_corpus
from tools.fuzz.execution import Outcome
from tools.fuzz.stores import mutate_store
from tools.fuzz.study_corpus import LINES
from tools.fuzz.texts import DIRECTIVES, MUTATIONS, TAGS
from tools.fuzz.verdict import find_place, judge, judge_surroundings


@pytest.fixture(scope="module")
def maker() -> Maker:
    return Maker(build_corpus())


@pytest.mark.slow
def test_input_follows_from_its_seed_alone(maker) -> None:
    seeds = range(4)
    first = [maker.make(seed) for seed in seeds]
    again = [maker.make(seed) for seed in reversed(seeds)][::-1]
    assert first == again
    assert len({case.seed for case in first}) == len(seeds)


@pytest.mark.slow
def test_every_command_has_its_turn(maker) -> None:
    lines = [line for machine in maker.machines for line in machine.lines]
    assert {line.words[0] for line in lines} == set(list_commands())


@pytest.mark.parametrize("name", list_commands())
def test_every_option_of_a_command_is_drawn(name) -> None:
    command = list_commands()[name]
    drawn = {
        word
        for seed in range(400)
        for word in draw_options(command, Random(seed), ["a"], ["a.csv"])
    }
    assert {opt for p in command.params for opt in p.opts if opt.startswith("-")} <= drawn


def test_file_that_is_left_open_is_a_find(tmp_path) -> None:
    outcome = answer(0)
    outcome.warned = ["ResourceWarning: unclosed file <x> (os:1)"]
    case = Case(1, "five-bar", ["check", "robot.yaml"], {}, [])
    assert {find.rule for find in judge(case, outcome, tmp_path)} == {"warning"}


def answer(code, out="", err="", before=(), after=()) -> Outcome:
    return Outcome(code, out, err, before=dict(before), after=dict(after))


@pytest.mark.parametrize(
    ("outcome", "rules"),
    [
        (answer(1, err="loopcal: robot.yaml:3: no.\nHint: write 3\n"), []),
        (answer(1, err="loopcal: this is wrong.\nHint: see loopcal x --help\n"), ["no-name"]),
        (answer(1, err="loopcal: use --force.\n"), []),
        (answer(1, err="Warning: robot.yaml\n"), ["message-form"]),
        (answer(1, err="loopcal: \x1b[31mrobot.yaml\n"), ["control-character"]),
        (answer(1), ["no-message"]),
        (answer(3, err="loopcal: robot.yaml\n"), ["exit-code"]),
        (answer(1, err="loopcal: robot.yaml\n", after={"out": b"1"}), ["left-output"]),
        (answer(1, err="loopcal: robot.yaml\n", before={"a": b"1"}), ["deleted-file"]),
        (
            answer(1, err="loopcal: robot.yaml\n", before={"a": b"1"}, after={"a": b"2"}),
            ["changed-file"],
        ),
        (answer(1, err="loopcal: robot.yaml <class 'float'>\n"), ["internal-words"]),
        (answer(0, out="error: nan mm\n"), ["no-number", "non-finite"]),
        (answer(0, out="information\n"), []),
        (answer(1, err="loopcal: robot.yaml: a gap of unknown mm\n"), ["no-number"]),
        (answer(1, err="loopcal: robot.yaml:1: '-inf um' is not finite\n"), []),
        (answer(0, out='{"text": "it is -inf deg"}\n'), ["no-number", "non-finite"]),
        (answer(0, after={"a.csv": b"x\ninf\n"}), ["non-finite"]),
        (answer(0, after={"a.json": b"{"}), ["unreadable"]),
        (answer(0, after={"a.csv": b"\xff"}), ["unreadable"]),
        (answer(0, after={"a.yaml": b"format: 1\nfamily: x\nunits: {}\n"}), ["unreadable"]),
    ],
)
def test_answers_that_break_a_rule_are_finds(tmp_path, outcome, rules) -> None:
    case = Case(1, "five-bar", ["check", "robot.yaml"], {})
    assert [find.rule for find in judge(case, outcome, tmp_path)] == rules


def test_answer_that_depends_on_files_or_variables_of_others_is_a_find() -> None:
    case = Case(1, "m", ["check"], {}, foreign={"matplotlibrc": b"x"}, variables={"TZ": "x"})
    both = {"robot.yaml": b"1"}
    foreign = {"matplotlibrc": b"x"}
    plain, same = answer(0, "a", after=both), answer(0, "a", after=both | foreign)
    assert judge_surroundings(case, same, plain) == []
    for other, what in (
        (answer(1, "a", after=both), "exit code"),
        (answer(0, "b", after=both), "stdout"),
        (answer(0, "a", after={"robot.yaml": b"2"}), "file .yaml"),
        (answer(0, "a", after=both | {"new.csv": b""}), "file .csv"),
    ):
        (find,) = judge_surroundings(case, other, plain)
        assert find.signature == f"surroundings: ['check'] {what}"


def test_tables_values_and_bits_of_a_store_are_damaged(tmp_path) -> None:
    header = StoreHeader("{}", ("a",), {})
    make_store(tmp_path, header)
    content = (tmp_path / NAME).read_bytes()
    damages = [mutate_store(content, Random(seed)) for seed in range(200)]
    assert {damage[1] for damage in damages if damage} == {"schema", "value"}
    assert sum(damage is not None and damage[0] != content for damage in damages) > 60
    assert any(damage and b"TRIGGER" in damage[0] for damage in damages)


def test_every_tag_and_directive_is_written_where_a_value_begins() -> None:
    text = b"# a: [1, 2]\n# b: {c: 3}\nx,y\n1,2\n"
    written = [MUTATIONS["tag"](text, Random(seed)) for seed in range(2000)]
    for word in (*TAGS, *DIRECTIVES):
        assert any(word.encode() in changed for changed in written)


def test_traceback_is_known_by_its_innermost_function_of_loopcal(tmp_path) -> None:
    text = (
        'File "/a/src/loopcal/io/a.py", line 3, in f\nFile "/a/src/loopcal/io/b.py", line 4, in g\n'
        'File "/a/numpy/c.py", line 5, in h\n'
    )
    assert find_place(text) == "loopcal/io/b.py:g"
    outcome = Outcome(failures=[("ValueError", text)])
    (find,) = judge(Case(1, "five-bar", ["check"], {}), outcome, tmp_path)
    assert find.signature == "traceback: ValueError at loopcal/io/b.py:g"


def test_ranges_of_seeds_are_joined() -> None:
    assert join_ranges([[5, 6], [1, 2], [3, 4], [9, 9]]) == [[1, 6], [9, 9]]


def test_every_command_of_studies_has_its_turn() -> None:
    words = [line.split()[1:] for line in LINES.strip().splitlines()]
    assert {word for _, word, *_ in words} == set(study.commands)
    commands = list_commands()
    assert name_command(["study", "run", "x"], commands) == "study run"
    assert name_command(["study", "rnu", "x"], commands) == "(none)"
    assert describe(["study", "run", "x", "--quick", "-x"], commands) == ["study run --quick"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "options"), [(8, []), pytest.param(2, ["--studies"], marks=pytest.mark.evidence)]
)
def test_random_inputs_have_their_answers(root, count, options) -> None:
    """In a process of its own, because the workers are forks; the evidence has 5,000 inputs."""
    command = [sys.executable, "-m", "tools.fuzz", "--count", str(count), "--seed", "1", *options]
    environment = os.environ | {"PYTHONPATH": f"{root / 'src'}{os.pathsep}{root}"}
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{count} inputs" in done.stdout


@pytest.mark.evidence
@pytest.mark.parametrize(
    "name", ["docs/evidence/random_inputs.json", "evidence/random_inputs_longest.json"]
)
def test_no_random_input_of_the_evidence_broke_a_rule(root, name) -> None:
    """Readings that fit nothing, with redundant actuators and a robust refit, or a study with more
    trials, may take over ten seconds. These were 10 of the 101,022 inputs of the longest run and 1
    of the 5,000 others; on a busy machine they are more, so that one in a thousand is allowed. A
    find of the longest run that was mended names its test.
    """
    counts = json.loads((root / name).read_text("utf-8"))
    slow = {s: f["count"] for s, f in counts["finds"].items() if "TimeIsUp processor" in s}
    others = [f for s, f in counts["finds"].items() if s not in slow]
    for find in others:
        file, _, test = find["mended"].partition("::")
        assert f"def {test}(" in (root / file).read_text("utf-8")
    assert not others or name.startswith("evidence")
    assert 1_000 * sum(slow.values()) <= counts.get("counts", counts)["inputs"]
