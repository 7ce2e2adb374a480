# SPDX-License-Identifier: Apache-2.0
"""Every file that the package writes is read before it takes its name, whoever writes it.

`COMMANDS` has a command for each function of the package that writes a file. A search in the source
finds these functions, so that a new one fails here until it is tested.
"""

import ast
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

import loopcal
from loopcal.cli import main
from loopcal.errors import FileError
from loopcal.papers.writing import write_folder
from tests.papers.small_reproduction import MADE_BY, build_reproduction
from tools.fuzz.sources import SOURCES

PACKAGE = Path(loopcal.__file__).parent

CORE = ("write_text", "write_bytes", "replace_file", "replace_folder", "write_result_folder")
"""Functions of `loopcal.io.core` that write; all need a function that reads what was written."""

LIBRARY = {"savez", "save", "savetxt", "savefig", "dump", "to_csv", "tofile", "writelines"}
LIBRARY |= {"mkstemp", "fdopen", "mkdir", "makedirs", "hardlink_to", "copy2", "NamedTemporaryFile"}
"""Functions of Python and libraries that can write."""

USES_LIBRARY = {
    "cli/defect_report.py": "the report of a defect is for people, and must not fail",
    "cli/terminal.py": "writes to the null device",
    "io/example_folders.py": "writes the files of a new folder, and has it read",
    "io/core/outputs.py": "makes the folder for a folder",
    "io/core/replacement.py": "makes, renames and restores temporary files",
    "io/core/result_folder.py": "writes folders, and has them read",
    "io/core/text_file.py": "writes files, and has them read",
    "studies/results/export.py": "writes a long table row by row, and has it read",
    "studies/files/study_folder.py": "writes the files of a new folder, and has it read",
    "studies/results/summary_view.py": "makes a table in memory",
    "cli/commands/regularize_command.py": "makes a table in memory",
    "io/runs/run_folder.py": "makes arrays.npz in memory",
    "papers/drawing.py": "draws into memory",
    "report/pictures.py": "draws into memory",
}
"""Modules that use them, and why they may."""

COMMANDS = {
    "io/robot/robot_file.py:write_robot": (
        "new five-bar -o F.yaml",
        "simulate five-bar -o d.csv --draw-errors --truth F.yaml",
        "import robot.g --format reprap -o F.yaml",
        "import robot.urdf --closures loops.yaml -o F.yaml",
    ),
    "cli/commands/robot_commands.py:new": ("new five-bar -o new.yaml --measurements F.csv",),
    "cli/commands/robot_commands.py:check": tuple(
        f"check five-bar --plot F{ending}" for ending in (".png", ".svg", ".pdf")
    ),
    "io/data/measurement_writer.py:save_measurements": (
        "simulate five-bar --draw 4 -o F.csv",
        "import printer.cfg -o p.yaml --data F.csv",
    ),
    "io/exports/converted_file.py:save_table": (
        "import spheres.csv --profile spheres.yaml -o F.csv",
        "fill five-bar sheet.csv spheres.csv --profile spheres.yaml --allow-implausible -o F.csv",
    ),
    "cli/commands/sheet_commands.py:gcode": ("gcode linear-delta stops.csv -o F.ngc",),
    "io/runs/draws_file.py:save_draws": (
        "bootstrap run --count 5 -o F.csv",
        "sample run --count 100 -o F.csv",
    ),
    "io/runs/comparison_file.py:save_comparison": ("compare run second -o F.csv",),
    "io/runs/compensation_file.py:save_compensation": ("compensate run targets.csv -o F.csv",),
    "cli/commands/exchange_commands.py:export": (
        "export delta.yaml -o F.cfg",
        "export delta.yaml --into printer.cfg -o F.cfg",
        "export delta.yaml --format marlin -o F.g",
        "export delta.yaml --format reprap --into robot.g -o F.g",
        "export run -o F.json",
        "export run -o F.csv",
        "export hexapod.yaml --into hexapod.hal -o F.hal",
        "export hexapod-42 -o F.ini",
        "export tripod.yaml --into robot.urdf -o F.urdf",
    ),
    "cli/commands/exchange_commands.py:_correct_file": (
        "import printer.cfg -o p.yaml --data p.csv --corrected F.cfg",
    ),
    "io/runs/run_folder.py:write_run_folder": ("calibrate five-bar data.csv --hold-out 0.25 -o F",),
    "io/runs/plan_folder.py:write_plan_folder": (
        "plan five-bar --kind position --candidates 20 --poses 7 --hold-out 2 -o F",
    ),
    "papers/writing.py:write_folder": ("STUDY",),
    "studies/files/template.py:write_study_text": ("study new --robot five-bar F.yaml",),
    "papers/paper_studies.py:write": ("study new --paper hexapod-42 F.yaml",),
    "io/runs/curves_folder.py:write_curves": ("regularize five-bar data.csv -o F",),
    "documents/writing.py:write_document": (
        "compare run second -o F.html",
        "compare run second -o F.json",
        "report run -o F.html",
        "view five-bar -o F.html --no-browser",
        "view run -o F.html --no-browser",
    ),
}
"""Commands that write the file or folder F, by the function that writes it."""

COPIES = {"io/example_folders.py:write_example": "tests/cli/test_help_commands.py"}
"""Functions that copy files and replace nothing, and the tests that damage what they write."""

OF_STUDIES = {
    "studies/results/export.py:export_trials": "the table is read to its end, its rows are counted",
    "studies/replay_run.py:calibrate_trial": "robot file and measurements are read as such",
    "studies/files/study_folder.py:_make_folder": "the study file is read with its robots",
    "studies/results/summary_view.py:write_summary": "each file is read by the reader of its kind",
}
"""Functions of studies that need a computed study, with their readers; not damaged here."""

BY_BROWSER = {"documents/printing.py:print_pdf": "begin and end of the PDF file are read"}
"""Functions that need Chromium, with what is read; see tests/documents/test_browser.py."""

FILES = {
    "io/runs/curves_folder.py:write_curves": ("curves.csv",),
    "cli/commands/exchange_commands.py:_correct_file": ("F.cfg",),
    "io/runs/run_folder.py:write_run_folder": ("result.json", "robot.yaml", "arrays.npz"),
    "io/runs/plan_folder.py:write_plan_folder": (
        "plan.csv",
        "measurements.csv",
        "plan.json",
        "plan.png",
    ),
    "papers/writing.py:write_folder": ("result.json", "extra.csv", "extra.json", "curve.png"),
}
"""Names of the files of folders, and of commands that compute for long: one damage each."""


DRAWS_MUCH = ("report run -o F.html",)
"""Commands that draw many pictures: one damage of each file too, as others use their writer."""


@cache
def parse_source() -> tuple[tuple[str, ast.AST, str], ...]:
    """Return module, node, and the outermost function around it, of all names and calls."""
    nodes = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text("utf-8")
        if not any(name in text for name in (*CORE, *LIBRARY, "open(")):
            continue
        module = path.relative_to(PACKAGE).as_posix()
        body = ast.parse(text).body
        methods = (node for top in body if isinstance(top, ast.ClassDef) for node in top.body)
        for top in chain((top for top in body if not isinstance(top, ast.ClassDef)), methods):
            nodes += [(module, node, getattr(top, "name", "")) for node in ast.walk(top)]
    return tuple(nodes)


def list_names() -> Iterator[tuple[str, str, ast.AST, str]]:
    """Yield module, name, its node, and the function around it, of all names in use."""
    for module, node, owner in parse_source():
        if isinstance(node, ast.Name | ast.Attribute):
            yield module, node.id if isinstance(node, ast.Name) else node.attr, node, owner


def list_openings() -> Iterator[str]:
    """Yield the modules that open a file with a mode that writes."""
    for module, call, _ in parse_source():
        if isinstance(call, ast.Call) and ast.unparse(call.func).rpartition(".")[2] == "open":
            words = [*call.args, *(keyword.value for keyword in call.keywords)]
            modes = [word.value for word in words if isinstance(word, ast.Constant)]
            if any(re.fullmatch(r"[wax][bt+]*|r.?\+", str(mode)) for mode in modes):
                yield module


def test_no_module_writes_files_itself() -> None:
    """Only the core does, and what writes into memory or to nobody."""
    methods = {
        module
        for module, name, node, _ in list_names()
        if isinstance(node, ast.Attribute) and name in ("write_text", "write_bytes")
    }
    library = {module for module, name, *_ in list_names() if name in LIBRARY}
    assert methods | library | set(list_openings()) == set(USES_LIBRARY)


def test_every_writer_has_a_command_here() -> None:
    writers = {
        f"{module}:{owner}"
        for module, name, node, owner in list_names()
        if name in CORE and isinstance(node, ast.Name) and not module.startswith("io/core/")
    }
    assert writers == set(COMMANDS) | set(COPIES) | set(OF_STUDIES) | set(BY_BROWSER)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, root) -> Path:
    """Return a folder with the inputs of all commands."""
    folder = tmp_path_factory.mktemp("inputs")
    for name, text in SOURCES.items():
        (folder / name).write_text(text)
    for name in ("spheres.csv", "spheres.yaml"):
        shutil.copy(root / "examples" / "exports" / f"cmm-{name}", folder / name)
    (folder / "targets.csv").write_text("pose,x [mm],y [mm]\na,0,330\nb,10,320\n")
    (folder / "stops.csv").write_text("step,pose,use,x [mm],y [mm],z [mm]\n1,1,fit,10,5,100\n")
    rows = "".join(f"{i},{90 + 5 * i},{60 + 3 * i},,,\n" for i in range(1, 9))
    header = "# kind: position\n# noise: {x: 1 um, y: 1 um, z: 1 um}\n"
    columns = "pose,left [deg],right [deg],x [mm],y [mm],z [mm]\n"
    (folder / "sheet.csv").write_text(header + columns + rows)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in (
            "simulate five-bar --draw 10 --kind position --draw-errors -o data.csv",
            "calibrate five-bar data.csv -o run",
            "simulate five-bar --draw 10 --kind position --draw-errors -o more.csv --seed 2",
            "calibrate five-bar more.csv -o second",
            "simulate linear-delta --draw-errors --draw 2 -o d.csv --truth delta.yaml",
            "import hexapod.hal --unit mm --home-z 200mm -o hexapod.yaml",
            "import robot.urdf --closures loops.yaml -o tripod.yaml",
        ):
            assert main(command.split()) == 0
    return folder


def halve(content: bytes) -> bytes:
    """Return the first half."""
    return content[: len(content) // 2]


def change_digit(content: bytes) -> bytes:
    """Return the content with another digit in the last number, not in a remark of a table.

    It is one of the first eight: a number is read back equal to rounding, which is the 17th digit.
    """
    *_, last = re.finditer(rb"^(?!##).*?([0-9]+)[^0-9\n]*$", content, re.MULTILINE)
    place = last.start(1) + min(len(last[1]), 8) - 1
    digit = b"1" if content[place : place + 1] != b"1" else b"2"
    return content[:place] + digit + content[place + 1 :]


def run(command: str) -> int:
    """Run a command; return its exit code, or 1 where a study cannot be written."""
    if command != "STUDY":
        return main([*command.split(), "--force"])
    try:
        write_folder("F", build_reproduction(), MADE_BY, force=True)
    except FileError as error:
        sys.stderr.write(str(error))
        return 1
    return 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("writer", "command"), [(writer, c) for writer, words in COMMANDS.items() for c in words]
)
def test_a_damaged_file_replaces_nothing(
    inputs, tmp_path, monkeypatch, capsys, writer: str, command: str
) -> None:
    """Each file of the output loses its second half, or a digit, as if its writer were wrong."""
    shutil.copytree(inputs, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    assert run(command) in (0, 2)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    outputs = [word for word in command.split() if word.startswith("F")]
    names = FILES.get(writer, dict.fromkeys((*outputs, "F.json")))  # of a report, beside its page
    assert any(path.name in names for path in before)
    survived = []
    for name in names:
        if not any(path.name == name for path in before):
            continue
        is_text = not name.endswith((".png", ".svg", ".pdf", ".npz"))
        is_quick = writer not in FILES and command not in DRAWS_MUCH
        damages = (halve, change_digit) if is_quick else (change_digit,)
        for damage in damages if is_text else (halve,):
            with monkeypatch.context() as patch:
                patch.setattr(Path, "write_bytes", write_damaged(name, damage))
                capsys.readouterr()
                code = run(command)
            message = " ".join(capsys.readouterr().err.split())
            if code != 1 or "This is a defect of loopcal" not in message:
                survived.append((name, damage.__name__, code, message))
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert survived == []
    assert {p for p in before | after if before.get(p) != after.get(p)} <= {tmp_path / "d.csv"}


def write_damaged(name: str, damage: Callable[[bytes], bytes]) -> Callable[[Path, bytes], int]:
    """Return a function in place of Path.write_bytes that damages the files of one name."""
    write = Path.write_bytes

    def write_bytes(path: Path, content: bytes) -> int:
        return write(path, damage(content) if path.name.endswith(name) else content)

    return write_bytes
