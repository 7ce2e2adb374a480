# SPDX-License-Identifier: Apache-2.0
"""Every damage of a run folder is named with its file, before anything is computed."""

import copy
import dataclasses
import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.height_errors import PREFIX, HeightErrors
from loopcal.cli.entry_point import main
from loopcal.errors import FileError, LoopcalError
from loopcal.estimate.posterior import DISCREPANCY_PREFIX
from loopcal.estimate.smooth_errors import describe_smooth_errors
from loopcal.io.runs.run_folder import FITTED, FORMS, Run, find_problem, read_result
from loopcal.report.calibration_view import view_budget
from loopcal.results.storage import store_arrays
from loopcal.units import find_unit
from tests.io.changed_documents import change_value, list_places

DATA = """# kind: position
# places: [[20 mm, 10 mm, 5 mm]]
# unknown: [frame]
# frame: tracker
# noise: {x: 10 um, y: 10 um, z: 10 um}
"""
COMMANDS = (
    "validate RUN new.csv",
    "budget RUN",
    "compensate RUN targets.csv",
    "compensate RUN/robot.yaml targets.csv",
    "export RUN -o parameters.csv",
    "bootstrap RUN --count 5",
    "sample RUN",
    "sample RUN --region -p west.length",
    "calibrate five-bar new.csv -o second --prior RUN",
)
"""Commands that read a run folder."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a run of a small robot with an unknown frame, and files to use it on."""
    folder = tmp_path_factory.mktemp("damaged")
    for name, seed in (("old.csv", 1), ("new.csv", 2)):
        words = f"simulate five-bar --draw 14 --kind position --seed {seed} -o {folder / name}"
        assert main(words.split()) == 0
        rows = [r for r in (folder / name).read_text().splitlines() if not r.startswith("#")]
        (folder / name).write_text(DATA + "\n".join(rows) + "\n")
    (folder / "targets.csv").write_text("x [mm],y [mm]\n0,150\n")
    report = lc.calibrate(
        robot := lc.load_robot("five-bar"),
        lc.load_measurements(folder / "old.csv", robot),
        lc.CalibrationOptions(hold_out=0.25),
    )
    lc.save_run(report, folder / "RUN", {"data": folder / "old.csv"}, ["loopcal", "calibrate"])
    return folder


@pytest.fixture
def run(folder, tmp_path, monkeypatch) -> Path:
    """Return a copy of the run, in the current folder."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "RUN"


def write_result(run: Path, result: Any) -> None:
    """Replace result.json."""
    (run / "result.json").write_text(json.dumps(result))


def write_arrays(run: Path, arrays: dict[str, np.ndarray]) -> None:
    """Replace arrays.npz by an intact one with other arrays, as result.json names it."""
    with (run / "arrays.npz").open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)
    result = json.loads((run / "result.json").read_text())
    content = (run / "arrays.npz").read_bytes()
    result["files"]["arrays.npz"] = hashlib.sha256(content).hexdigest()
    write_result(run, result)


def read_arrays(run: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an intact run."""
    with np.load(run / "arrays.npz") as archive:
        return dict(archive)


def use_everything(run: Run) -> None:
    """Use all that commands use of the result of a run; they may refuse, but not fail."""
    for use in (
        lambda: view_budget(run.load_budget(), run.robot),
        run.load_uncertainty,
        lambda: (run.failure, run.held_out, run.excluded, repr(run)),
    ):
        with suppress(LoopcalError):
            use()


def edit_zip(change: Callable[[bytearray], object]) -> Callable[[Path], object]:
    """Return a damage that changes the bytes of arrays.npz."""

    def edit(path: Path) -> None:
        content = bytearray(path.read_bytes())
        change(content)
        path.write_bytes(content)

    return edit


def pack(*entries: tuple[str, bytes]) -> bytes:
    """Return a zip archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return stream.getvalue()


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


BROKEN_FILES: dict[str, Callable[[Path], object]] = {
    "text": lambda path: path.write_text("not an archive"),
    "nothing": lambda path: path.write_bytes(b""),
    "no file": lambda path: path.unlink(),
    "folder": replace_by_folder,
    "empty archive": lambda path: path.write_bytes(pack()),
    "archive of text": lambda path: path.write_bytes(pack(("estimate.npy", b"1 2 3"))),
    "one array": lambda path: np.save(path.open("wb"), np.zeros(3)),
    "pickle": lambda path: np.save(path.open("wb"), np.array([{}]), allow_pickle=True),
    "truncated": edit_zip(lambda content: content.__delitem__(slice(len(content) // 2, None))),
    "half": edit_zip(lambda content: content.__delitem__(slice(0, len(content) // 2))),
    "one bit": edit_zip(lambda content: content.__setitem__(300, content[300] ^ 1)),
}


@pytest.mark.parametrize("damage", BROKEN_FILES)
@pytest.mark.parametrize("is_digest_right", [False, True])
def test_broken_archive_is_refused(run, damage, is_digest_right) -> None:
    path = run / "arrays.npz"
    BROKEN_FILES[damage](path)
    if is_digest_right and path.is_file():
        result = json.loads((run / "result.json").read_text())
        result["files"]["arrays.npz"] = hashlib.sha256(path.read_bytes()).hexdigest()
        write_result(run, result)
    with pytest.raises(FileError, match=r"arrays\.npz"):
        lc.load_run(run)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_names_the_damaged_file(run, capsys, command) -> None:
    (run / "arrays.npz").write_bytes(pack())
    before = sorted(path.name for path in run.parent.rglob("*"))
    assert main(command.split()) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "RUN/arrays.npz: this file of a run is damaged" in err
    assert err.endswith("repeat the calibration\n")
    write_result(run, {"format": 2})
    assert main(command.split()) == 1
    assert "RUN/result.json: this file of a run is damaged: this file has no key 'made_by'" in (
        capsys.readouterr().err
    )
    assert sorted(path.name for path in run.parent.rglob("*")) == before


def list_wrong_arrays(array: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Return arrays that are not allowed in place of one."""
    yield "object", np.full(array.shape, None)
    yield "one axis more", array[..., None]
    yield "scalar", np.zeros((), array.dtype)
    yield "complex", np.zeros((*array.shape, 1), complex)[..., 0]
    yield "bytes", np.full(array.shape, b"x")
    yield "longer", np.concatenate([array, np.ones((1, *array.shape[1:]), array.dtype)])
    if array.dtype.kind == "f":
        yield "single", array.astype("f4")
        yield "text", array.astype(str)
        yield "whole", np.zeros(array.shape, dtype=int)
    if array.dtype.kind == "f" and array.size:
        yield "shorter", array[:-1]


def test_every_array_of_a_wrong_form_is_refused_by_name(folder) -> None:
    arrays = read_arrays(folder / "RUN")
    errors = describe_smooth_errors(np.tile(np.eye(4), (3, 1, 1)), np.zeros(3), 1.0)
    own = store_arrays(errors, DISCREPANCY_PREFIX)
    m, p = 6 * len(own["discrepancy_centers"]), len(arrays["estimate"])
    own |= {"discrepancy_root": np.zeros((p, m)), "discrepancy_degrees": np.ones(6)}
    own |= {"discrepancy_test": np.ones(4), "discrepancy_mean": np.ones(m)}
    own |= {"discrepancy_axes": np.eye(m), "discrepancy_left": np.ones(m)}
    own |= {"discrepancy_directions": np.eye(p), "discrepancy_variance": np.ones(p)}
    arrays |= own
    heights = HeightErrors(
        ("1", "2"), np.ones((2, 2)), np.ones(2), np.ones(2), np.ones(2, dtype=bool), find_unit("mm")
    )
    arrays |= store_arrays(heights, PREFIX)
    arrays["posterior_reading_sigma"] = np.ones(arrays["frames_readings"].shape[1])
    assert set(FORMS) <= set(arrays)
    assert {name for name in FORMS if name.startswith("discrepancy_")} == set(own)
    assert find_problem(arrays) is None
    for name in (*FORMS, "fitted_0_position"):
        if name in FORMS:
            without = {key: array for key, array in arrays.items() if key != name}
            is_alone = name in ("posterior_shown_noise", "posterior_reading_sigma")
            assert (find_problem(without) is None) == is_alone, name
        for form, wrong in list_wrong_arrays(arrays[name]):
            problem = find_problem(arrays | {name: wrong})
            is_free = name in ("fitted_0_position", "frames_readings", "initial")
            assert (is_free and form in ("longer", "shorter")) or problem is not None, (name, form)
        if FORMS.get(name, FITTED).startswith("finite") and arrays[name].size:
            wrong = np.full(arrays[name].shape, np.nan)
            assert find_problem(arrays | {name: wrong}) is not None, name


CONTRADICTIONS = {
    "frames_names": lambda a: np.repeat(a, 2),
    "frames_by_parameters": lambda a: a[:, :, :-1],
    "posterior_source": lambda a: np.frombuffer(
        np.array([0x110000] * len(a), dtype=np.uint32).tobytes(), dtype="<U1"
    ),
    "initial": lambda a: a[:-1],
    "local_estimate": lambda a: a[:0],
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_arrays_that_contradict_each_other_or_the_result_are_refused(run, name) -> None:
    arrays = read_arrays(run)
    arrays[name] = CONTRADICTIONS[name](arrays[name])
    write_arrays(run, arrays)
    with pytest.raises(FileError, match="RUN"):
        lc.load_run(run)


READ = ("format", "made_by", "verdict", "passed", "reasons", "split", "nulls", "files")
OF_FIT = ("parameters", "local", "status", "dropped", "sigma_scale")
WRONG = (..., -1.5, "{x}", [], {}, None, True, [[1]], {"a": 1}, 10**30)


@pytest.mark.slow
def test_every_wrong_value_of_a_result_is_refused_or_harmless(run) -> None:
    """The parts that loopcal reads are tried in full, with all kinds of values."""
    whole = json.loads((run / "result.json").read_text())
    budget = copy.deepcopy(whole["expected_error"])
    budget["sources"] = budget["sources"][:1]
    budget["finding"] = {"text": budget["finding"]["text"]}
    for name in ("position", "orientation"):
        budget[name] = {"rms": budget[name]["rms"]}
    for key in ("parameters", "local"):
        rows = whole["fit"][key]
        whole["fit"][key] = [{k: row[k] for k in ("name", "plus_minus")} for row in rows]
    whole = {key: whole[key] for key in READ} | {
        "fit": {key: whole["fit"][key] for key in OF_FIT},
        "expected_error": budget,
    }
    intact = lc.load_run(run)
    sentences, tried = [], 0
    for place in list_places(whole):
        for value in WRONG:
            write_result(run, change_value(whole, place, value))
            tried += 1
            sentence, result = read_or_refuse(run / "result.json")
            if sentence is None:
                use_everything(dataclasses.replace(intact, result=result))
            else:
                sentences.append(sentence)
    assert all("RUN/result.json: " in text and ". " in text for text in sentences)
    assert len(sentences) > 0.6 * tried > 300


def read_or_refuse(path: Path) -> tuple[str | None, dict[str, Any]]:
    """Return the sentence with which a result is refused, or its content."""
    try:
        return None, read_result(path)
    except FileError as error:
        return str(error), {}


MISTYPED = {
    "": "is empty",
    "{": ":1: not valid JSON (Expecting property name",
    "[1, 2]": "it contains no mapping",
    '{"format": NaN}': "the number NaN is not finite",
    '{"format": 1e999}': "the number 1e999 is not finite",
    '{"format": 1, "format": 1}': "the key 'format' is there twice",
    "[" * 100_000: "levels of nesting",
    '{"format": "2"}': "'format' is the text '2', but must be a whole number",
    '{"format": 1}': "this run has format 1, but this loopcal reads format 2. Calibrate again",
    '{"format": 99}': "this run has format 99, but this loopcal reads format 2. Calibrate again",
    "9" * 5000: "not valid JSON (",
}


@pytest.mark.parametrize("text", MISTYPED, ids=lambda text: text[:12])
def test_result_that_is_no_plain_json_is_refused(run, text) -> None:
    (run / "result.json").write_text(text)
    with pytest.raises(FileError) as caught:
        lc.load_run(run)
    assert "RUN/result.json:" in str(caught.value)
    assert MISTYPED[text] in str(caught.value)


def test_a_changed_robot_file_is_read_while_its_parameters_are_those_of_the_run(run) -> None:
    path = run / "robot.yaml"
    text = path.read_text()
    path.write_text(text.replace("name: five-bar", "name: our five-bar"))
    assert lc.load_run(run).robot.name == "our five-bar"
    path.write_text(text.replace("units:", "fixed: [west.length]\nunits:"))
    with pytest.raises(FileError, match=r"robot\.yaml: .*compare 'west\.length'"):
        lc.load_run(run)


@pytest.mark.parametrize("key", ["parameters", "local"])
@pytest.mark.parametrize("change", [{"unit": "um"}, {"unit": "?"}, {"estimate": 1.0}])
def test_an_estimate_that_the_arrays_do_not_hold_is_refused(run, key, change) -> None:
    result = json.loads((run / "result.json").read_text())
    result["fit"][key][1] |= change
    write_result(run, result)
    with pytest.raises(FileError, match=rf"'fit\.{key}' states .* but the array '.*' of the run"):
        lc.load_run(run)
