# SPDX-License-Identifier: Apache-2.0
"""Files beyond a limit are refused in one sentence, before they take memory or time."""

import io
import json
import os
import time
import zipfile
from pathlib import Path

import click
import numpy as np
import pytest

from loopcal.cli.entry_point import SECTIONS, find_command, main
from loopcal.cli.options import Count
from loopcal.errors import FileError, MechanismError
from loopcal.io.core import limits
from loopcal.io.core.csv_table import read_table
from loopcal.io.core.text_file import read_bytes, read_json, read_text, sha256
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.robot.robot_file import find_robot_file, load_robot
from loopcal.io.runs.run_folder import read_arrays

FIVE_BAR = find_robot_file("five-bar").read_text("utf-8")
SMALL = limits.FileLimit("size", 0.01, "MB", "shorten it")


def write(folder: Path, text: str, name: str = "file.yaml") -> Path:
    path = folder / name
    path.write_text(text, "utf-8")
    return path


def test_file_above_its_limit_is_refused_with_both_numbers(tmp_path) -> None:
    path = write(tmp_path, "x" * 20_000)
    with pytest.raises(FileError) as refusal:
        read_bytes(path, "robot file", SMALL)
    expected = "this robot file has 0.02 MB, but the limit is 0.01; shorten it"
    assert str(refusal.value) == f"{path}: {expected}"
    assert refusal.value.code == "files.limit-exceeded"
    assert len(read_bytes(write(tmp_path, "x" * 10_000), "robot file", SMALL)) == 10_000


def test_file_without_a_stated_size_is_read_up_to_the_limit() -> None:
    # the size of files in /proc is stated as 0
    if not Path("/proc/self/smaps").exists():
        pytest.skip("this system has no /proc")
    with pytest.raises(FileError, match=r"has more than 0.01 MB, which is the limit"):
        read_text("/proc/self/smaps", "robot file", limit=limits.FileLimit("", 0.01, "MB"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with names")
def test_pipes_and_devices_are_refused_at_once(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), Path("/dev/tty")):
        if path.exists():
            for read in (lambda p: read_bytes(p, "robot file"), sha256, load_robot, read_table):
                with pytest.raises(FileError, match=r"device or a pipe|cannot read"):
                    read(path)
    with pytest.raises(FileError, match=r"does not exist|cannot read"):
        read_bytes("/proc/kmsg", "robot file")  # a file, but reading it waits


def test_settings_beside_a_table_may_be_no_pipe(tmp_path) -> None:
    os.mkfifo(tmp_path / "data.yaml")
    with pytest.raises(FileError, match="device or a pipe"):
        read_table(write(tmp_path, "pose,q1 [mm]\np1,2\n", "data.csv"))


def make_alias_bomb(levels: int = 9) -> str:
    lines = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, levels + 1)]
    return "\n".join(["a0: &a0 [x]", *lines]) + "\n"


def test_aliases_count_as_what_they_stand_for(tmp_path) -> None:
    path = write(tmp_path, FIVE_BAR + make_alias_bomb())
    with pytest.raises(FileError, match="has more than 50,000 values, which is the limit") as error:
        load_robot(path)
    assert error.value.line == FIVE_BAR.count("\n") + 6
    assert read_yaml(write(tmp_path, make_alias_bomb(3)), "robot file").content["a3"]


def test_alias_within_its_own_value_is_refused(tmp_path) -> None:
    for text in ("a: &a [*a]\n", "a: &a {b: {c: *a}}\n", "a: &a {<<: *a}\n"):
        with pytest.raises(FileError, match=r"alias 'a' stands for a value that contains"):
            read_yaml(write(tmp_path, f"format: 1\n{text}"), "robot file")


def test_reused_anchor_counts_its_latest_value(tmp_path) -> None:
    nested = "x: &x [1]\ny: &x [2, 2]\nz: [*x, *x]\n"
    assert read_yaml(write(tmp_path, nested), "robot file").content["z"] == [[2, 2], [2, 2]]


@pytest.mark.parametrize(
    "text", ["a: " + "[" * 60 + "]" * 60, "a: " + "{b: " * 60 + "}" * 60, "a: " + "[" * 5000]
)
def test_deep_nesting_is_refused_at_its_line(tmp_path, text: str) -> None:
    with pytest.raises(FileError, match=r"yaml:2: .* more than 50 levels of nesting"):
        read_yaml(write(tmp_path, f"name: x\n{text}\n"), "robot file")


@pytest.mark.parametrize("comment", ["# " + "x" * 1_100_000, "# x\n" * 300_000])
def test_comments_count_as_part_of_the_file(tmp_path, comment: str) -> None:
    start = time.process_time()
    with pytest.raises(FileError, match=r"has 1\.\d+ MB, but the limit is 1; shorten its comments"):
        load_robot(write(tmp_path, f"{FIVE_BAR}{comment}\n"))
    remarks = "".join(f"#{line}\n" for line in comment.split("\n"))
    with pytest.raises(FileError, match=r"has 1.* MB, but the limit is 1"):
        read_table(write(tmp_path, f"# kind: pose\n{remarks}pose,q1 [mm]\np,1\n", "data.csv"))
    assert time.process_time() - start < 3.0


def test_copies_and_limbs_are_limited_before_they_are_made(tmp_path) -> None:
    def load(*counts: int) -> None:
        text = FIVE_BAR
        for count in counts:
            one = "    ending: distance\n    length: 300\n    errors"
            text = text.replace(
                one, f"    copies: {{count: {count}}}\n{one}".replace("300", "0300"), 1
            )
        load_robot(write(tmp_path, text.replace("0300", "300")))

    for count in (1_000_000_000, 101, 0, -1):
        with pytest.raises(MechanismError, match=rf"limb 'west' has {count} copies. Give 1 to 100"):
            load(count)
    with pytest.raises(MechanismError, match=r"five-bar has 110 limbs. Allowed: at most 100"):
        load(50, 60)


def test_json_is_limited_in_nesting(tmp_path) -> None:
    for depth in (300, 100_000):
        path = write(tmp_path, "[" * depth + "]" * depth)
        with pytest.raises(FileError, match=r"more than 200 levels|has 300 levels"):
            read_json(path, "file of samples", "correct it")
    with pytest.raises(FileError, match=r"not valid JSON .*1111… is too large"):
        read_json(write(tmp_path, "1" * 5000), "file of samples", "correct it")
    assert read_json(write(tmp_path, json.dumps({"a": [[1]]})), "file", "") == {"a": [[1]]}


def test_table_is_limited_in_rows_columns_and_length_of_lines(tmp_path) -> None:
    columns = ",".join(f"c{i}" for i in range(1001))
    with pytest.raises(FileError, match=r"csv:1: .* has 1,001 columns, but the limit is 1,000"):
        read_table(write(tmp_path, f"{columns}\n1\n", "data.csv"))
    with pytest.raises(FileError, match=r"csv:2: .* has 120,002 characters in one line"):
        read_table(write(tmp_path, f"a,b\n{'1' * 120_000},2\n", "data.csv"))


# arrays of a run folder


def archive(folder: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    path = folder / "arrays.npz"
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return path


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def test_arrays_are_read_as_numpy_wrote_them(tmp_path) -> None:
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.asfortranarray(np.arange(6).reshape(3, 2)),
        "names": np.array(["leg1", "leg2"]),
        "none": np.zeros((0, 4)),
        "yes": np.array(True),
    }
    np.savez(tmp_path / "arrays.npz", **arrays)
    found = read_arrays(tmp_path / "arrays.npz")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_zip_bomb_is_refused_before_it_is_expanded(tmp_path) -> None:
    bomb = npy(np.zeros(10**6))
    with pytest.raises(ValueError, match=r"compression of 'x\.npy'"):
        read_arrays(archive(tmp_path, {"x": bomb}, zipfile.ZIP_DEFLATED))
    limit = limits.FileLimit("", 1, "MB", "repeat the calibration")
    with pytest.raises(FileError, match=r"8\.01 MB, but the limit is 1"):
        read_arrays(archive(tmp_path, {"x": bomb}, zipfile.ZIP_DEFLATED), size=limit)
    many = {f"m{i}": b"" for i in range(1001)}
    with pytest.raises(FileError, match="has 1,001 arrays, but the limit is 1,000"):
        read_arrays(archive(tmp_path, many))


@pytest.mark.parametrize("shape", ["(100000000000,)", "(2, 10000000000)", "(5,)", "(-1,)"])
def test_header_that_states_another_size_than_the_file_has_is_refused(tmp_path, shape) -> None:
    member = npy(np.zeros(4)).replace(b"(4,)", shape.encode())
    length = len(member) - 10 - 32
    member = member[:8] + length.to_bytes(2, "little") + member[10:]
    with pytest.raises(ValueError, match="another size than its header"):
        read_arrays(archive(tmp_path, {"x": member}))


def test_damaged_archives_are_refused_with_a_reason(tmp_path) -> None:
    whole = archive(tmp_path, {"x": npy(np.arange(100.0))}).read_bytes()
    path = tmp_path / "damaged.npz"
    for content in (b"", whole[:-30], whole[: len(whole) // 2], b"PK" + whole[2:500] + whole[501:]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"\w"):
            read_arrays(path)
    changed = bytearray(whole)
    changed[300] ^= 1
    path.write_bytes(changed)
    with pytest.raises(ValueError, match="CRC"):
        read_arrays(path)
    with pytest.raises(ValueError, match="neither numbers nor text"):
        read_arrays(archive(tmp_path, {"x": npy(np.array([object()], dtype=object))}))
    with pytest.raises(ValueError, match="magic"):
        read_arrays(archive(tmp_path, {"x": b"not an array"}))


def test_documentation_lists_every_limit() -> None:
    page = (Path(__file__).parents[2] / "docs" / "files.md").read_text("utf-8")
    stated = [value for value in vars(limits).values() if isinstance(value, limits.FileLimit)]
    assert set(stated) == set(limits.LIMITS)
    for limit in limits.LIMITS:
        assert f"| {limit.of} | {limit} |" in page


COUNTED = {
    "DRAWN_POSES": ("simulate linear-delta -o d.csv --draw", "identifiability linear-delta --draw"),
    "PLANNED_POSES": ("plan linear-delta -o p --poses", "plan linear-delta -o p --hold-out"),
    "CANDIDATES": ("plan linear-delta -o p --candidates",),
    "GROUPS": ("plan linear-delta -o p --groups",),
    "POINTS": ("plan linear-delta -o p --points",),
    "RESAMPLES": ("bootstrap linear-delta d.csv --count",),
    "DRAWS": ("sample linear-delta d.csv --count",),
    "TRIALS": ("reproduce hexapod-42 --trials",),
    "STEPS": ("compensate run t.csv --steps", "per-leg hexapod-42 d.csv --steps"),
    "FOLDS": ("regularize linear-delta d.csv --folds",),
    "REPLICATES": ("study extend results --replicates",),
    "WORKERS": ("study run s.yaml -o results --workers", "study extend results --workers"),
    "STATIONS": ("plan linear-delta -o p --measure camera --stations",),
    "SQUARES": ("board -o board.yaml --columns", "board -o board.yaml --rows"),
}


@pytest.mark.parametrize("name", COUNTED)
def test_counts_on_the_command_line_are_refused_above_their_limit(name, capsys) -> None:
    """No file of these command lines exists: the number is refused before any is read."""
    limit = getattr(limits, name)
    for words in COUNTED[name]:
        for number in (limit.most + 1, 10**9 + 1, 10**400):
            assert main([*words.split(), str(number)]) == 1
            assert f"the limit is {limit}. Give a smaller number" in capsys.readouterr().err


def test_every_option_that_takes_a_count_has_a_limit() -> None:
    """A seed, the directions of --keep and the checks of a year take no memory."""
    unlimited, used = set(), set()
    for name in (name for members in SECTIONS.values() for name in members):
        command = find_command(name)
        assert command is not None, name
        subcommands = command.commands.values() if isinstance(command, click.Group) else ()
        for option in (o for c in (command, *subcommands) for o in c.params):
            if isinstance(option.type, Count) and option.type.limit:
                used.add(option.type.limit)
            elif isinstance(option.type, click.types.IntParamType):
                unlimited.add(option.name)
    assert unlimited == {"seed", "keep", "a_year", "port"}
    assert used == set(COUNTED)
    stated = {n for n, value in vars(limits).items() if isinstance(value, limits.CountLimit)}
    assert stated == set(COUNTED)


def test_lines_without_rows_are_counted_before_they_are_split(tmp_path) -> None:
    path = write(tmp_path, "q1 [mm]\n1\n" + "\n" * 5_000_000, "data.csv")
    with pytest.raises(FileError, match=r"has 5,000,002 lines, but the limit is 5,000,000"):
        read_table(path)


def test_values_of_json_text_are_counted_before_they_are_parsed(tmp_path) -> None:
    path = write(tmp_path, "[" + "[]," * 13_000_000 + "1]", "result.json")
    begin = time.process_time()
    with pytest.raises(FileError, match=r"has 26,000,001 values, but the limit is 25,000,000"):
        read_json(path, "run result", "repeat", limits.TABLE_SIZE)
    assert time.process_time() - begin < 2.0


@pytest.mark.parametrize("digits", ["9" * 350, "0x" + "f" * 300, "0x" + "f" * 9000, "9" * 9000])
def test_numbers_of_many_digits_are_refused_without_their_digits(tmp_path, digits) -> None:
    for text in (f"length: {digits}\n", f"length: [{digits}]\n"):
        with pytest.raises(FileError, match=r"too large|thousands of digits") as refusal:
            read_yaml(write(tmp_path, f"format: 1\n{text}"), "robot file")
        assert len(str(refusal.value)) < 200 + len(str(tmp_path))
