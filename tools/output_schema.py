# SPDX-License-Identifier: Apache-2.0
"""Write src/loopcal/cli/output.schema.json, the JSON Schema of what commands print with `--json`:
`python -m tools.output_schema`.

It runs every command in a temporary folder and takes the keys and types of the documents. A key
that some document of a command lacks is optional. A test runs the commands again and compares. If a
key vanishes or changes its meaning, FORMAT of `loopcal.cli.terminal` grows.
"""

import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from loopcal.cli.commands.study_commands import study
from loopcal.cli.entry_point import main
from loopcal.findings import Severity
from loopcal.io.file_schemas import DIALECT
from loopcal.io.pictures import choose_board
from loopcal.results.result import Result

SCHEMA = Path(__file__).parents[1] / "src" / "loopcal" / "cli" / "output.schema.json"
POSITION = "--kind position --sigma-position 20um"
VOLUME = "--volume x=-20mm..20mm --volume y=-20mm..20mm"
# Command lines in the order of a job, without --json. The exit code is 0 unless a digit begins one.
LINES = f"""
new linear-delta -o a.yaml --measurements a.csv {POSITION}
new --report-facts facts.yaml
schema robot
schema study -o study.schema.json
check a.yaml --expand
view a.yaml -o view.html --no-browser
example
example hexapod-42
completion bash
identifiability a.yaml --draw 20 {POSITION}
identifiability a.yaml --draw 20 --fix-unidentifiable --useful 10um {POSITION}
plan a.yaml -o plan --poses 12 --candidates 40 {POSITION}
gcode a.yaml plan -o poses.ngc
simulate a.yaml --fill plan/measurements.csv --draw-errors --truth truth.yaml -o d.csv
simulate truth.yaml --draw 20 --seed 2 {POSITION} -o e.csv
calibrate a.yaml d.csv -o may --limit-position 1mm {VOLUME}
calibrate a.yaml e.csv -o chosen --choose-model
calibrate a.yaml e.csv -o june --hold-out 0.25
calibrate a.yaml e.csv --noise estimated --method least-squares
calibrate a.yaml e.csv --prior may --compare truth.yaml
simulate truth.yaml --draw 20 --kind component --components z -o z.csv
calibrate a.yaml z.csv --method least-squares
calibrate hexapod-42 hexapod-42/measurements.csv -o hexapod
2 calibrate a.yaml wrong.csv -o failed
2 compensate failed targets.csv
2 export failed -o failed.csv
report may -o report.html --facts facts.yaml
certificate may facts-full.yaml
validate may e.csv
validate truth.yaml e.csv --limit-position 1mm
simulate truth.yaml --poses visits.csv --kind position -o visited.csv
repeatability truth.yaml visited.csv
calibrate a.yaml visited.csv --allow-duplicates
accuracy may {VOLUME}
budget may
compare may june
simulate truth.yaml --draw 5 --seed 3 {POSITION} -o week.csv
check-up may week.csv
compensate may targets.csv
compensate may targets.csv -o readings.csv --mode commands
regularize a.yaml d.csv
regularize a.yaml d.csv -o curves
bootstrap may --count 20
sample may --count 500
sample may --region -p radius -p tower1.stop
export may -o parameters.csv
export may --format klipper
import printer.cfg -o printer.yaml
import points.txt --profile own.yaml -o points.csv
fill a.yaml plan/measurements.csv points.txt --profile own.yaml -o filled.csv
measure plan -o session
app --no-browser --keep kept
study new study.yaml --robot linear-delta
study check study.yaml --quick
study run study.yaml -o results --quick --workers 1
study status results
study extend results --replicates 51 --workers 1
study summary results
study ask results --smallest poses --limit 100um
study export results -o trials.csv
study replay results 1/1 -o trial
study run study.yaml -o one --quick --workers 1 --cells 1/2
study run study.yaml -o two --quick --workers 1 --cells 2/2
study merge one two -o joined
reproduce
per-leg hexapod-42 hexapod-42/measurements.csv
board -o board.yaml --columns 7 --rows 6 --square 10mm
photos pictures --board board.yaml -o photos.csv
"""
FACTS = """\
number: "1"
country: DE
begin: 2026-11-02
end: 2026-11-03
machine: {name: delta, serial_number: "1"}
laboratory: {name: laboratory, country: DE}
customer: {name: customer, country: DE}
persons: [{name: somebody, role: head}]
environment: []
"""
PRINTER = """\
[printer]
kinematics: delta
delta_radius: 105
[stepper_a]
position_endstop: 300
arm_length: 220
[stepper_b]
[stepper_c]
"""
PROFILE = """\
format: 1
delimiter: comma
columns:
  pose: {from: Name}
  x: {from: X, unit: mm}
  y: {from: Y, unit: mm}
  z: {from: Z, unit: mm}
settings: {kind: position, noise: {"*": 20 um}}
"""
INPUTS = {
    "facts-full.yaml": FACTS,
    "targets.csv": "pose,x [mm],y [mm],z [mm]\n1,0,0,100\n2,10,20,120\n",
    "visits.csv": "pose,x [mm],y [mm],z [mm]\n" + "".join(f"{i},0,0,100\n" for i in range(4)),
    "printer.cfg": PRINTER,
    "points.txt": "Name,X,Y,Z\n1,0,0,0\n2,1,2,3\n3,4,5,6\n",
    "own.yaml": PROFILE,
}


def write_pictures(folder: Path) -> None:
    """Write pictures of a board of 7 x 6 squares."""
    import cv2

    board = choose_board(7, 6, 0.010)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    squares = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, dictionary)
    picture = squares.generateImage((700, 600), marginSize=30)
    folder.mkdir()
    for i in range(4):
        shifted = np.pad(picture, ((60 + i, 60), (60 + 3 * i, 60)), constant_values=220)
        cv2.imwrite(str(folder / f"{i}.png"), shifted)


def stop_app(err: io.StringIO) -> None:
    """End `app` as Ctrl-C does, when it has printed its address."""
    while "http://" not in err.getvalue():
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGINT)


def run_commands(lines: str = LINES) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and document of each command line, run in the current folder."""
    return ((name, json.loads(text)) for name, text in print_commands(lines, "--json"))


def print_commands(lines: str = LINES, *options: str) -> Iterator[tuple[str, str]]:
    """Yield name and screen of each command line with `options`, run in the current folder."""
    for name, text in INPUTS.items():
        Path(name).write_text(text)
    write_pictures(Path("pictures"))
    for line in lines.strip().splitlines():
        code = int(line[0]) if line[0].isdigit() else 0
        words = line.removeprefix(f"{code} ").split()
        out, err = io.StringIO(), io.StringIO()
        if Path("e.csv").exists():  # with a noise that contradicts it
            Path("wrong.csv").write_text(Path("e.csv").read_text().replace("20 um", "0.2 um"))
        sys.stdin = io.StringIO("")  # of `measure`
        if words[0] == "app":
            threading.Thread(target=stop_app, args=(err,), daemon=True).start()
        with redirect_stdout(out), redirect_stderr(err):
            found = main([*words, *options])
        assert found == code, (line, found, out.getvalue()[-800:], err.getvalue()[-800:])
        yield " ".join(words[: 1 + (words[0] == study.name)]), out.getvalue()


# Names of JSON types -> what Python reads.
TYPES = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "number": int | float,
    "null": type(None),
}


def name_type(value: Any) -> str:
    """Return the JSON type of a value."""
    return next(name for name, kind in TYPES.items() if isinstance(value, kind))


def describe_key(values: list[Any]) -> dict[str, Any]:
    """Return the schema of the values of a key: their types, and findings as such. Any of them may
    be null, where there is nothing to state.
    """
    entries = [x for value in values for x in (value if isinstance(value, list) else [value])]
    if entries and any(isinstance(v, list) for v in values) and all(map(is_finding, entries)):
        return {"type": "array", "items": {"$ref": "#/$defs/finding"}}
    return {"type": sorted({name_type(value) for value in values} | {"null"})}


def is_finding(value: Any) -> bool:
    """Return whether a value is a finding."""
    return isinstance(value, dict) and value.keys() == {"code", "severity", "data", "text"}


def build_schema(documents: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    """Return the schema of documents by the names of their commands."""
    texts = {"type": ["string", "null"]}
    error = {
        "type": {"type": "string", "description": "class of the exception in Python"},
        "code": {**texts, "description": "code of the message, if it has one"},
        "text": {"type": "string"},
        "hint": texts,
    }
    finding = {
        "code": {"type": "string", "pattern": r"^[a-z]+\.[a-z0-9-]+$"},
        "severity": {"enum": [severity.value for severity in Severity]},
        "data": {"type": "object"},
        "text": {"type": "string"},
    }
    numbered = {"format": {"type": "integer"}}
    shared = {
        "input_findings": {"type": "array", "items": {"$ref": "#/$defs/finding"}},
        "nulls": {"type": "object", "description": "place of a null -> why there is no number"},
    }
    definitions: dict[str, Any] = {
        "finding": describe_object(finding, finding),
        "error": describe_object({**numbered, "error": describe_object(error, error)}, ["error"]),
    }
    optional = list_optional_keys(Result)
    for name in dict.fromkeys(name for name, _ in documents):
        of = [document for command, document in documents if command == name]
        keys = list(dict.fromkeys(key for document in of for key in document if key not in shared))
        own = {key: describe_key([d[key] for d in of if key in d]) for key in keys}
        needed = [key for key in keys if all(key in d for d in of) and key not in optional]
        definitions[name] = describe_object({**own, **numbered, **shared}, needed)
    return {
        "$schema": DIALECT,
        "title": "what the commands of loopcal print with --json",
        "description": "The document of a command is #/$defs/COMMAND, such as calibrate or study "
        "run. A refusal (exit code 1) and a defect (exit code 3) are #/$defs/error.",
        "$defs": definitions,
    }


def list_optional_keys(base: type[Result]) -> set[str | None]:
    """Return the keys that results leave out where there is nothing to state."""
    kinds = base.__subclasses__()
    own = {field.json_key for kind in kinds for field in kind.FIELDS if field.is_optional}
    return own.union(*map(list_optional_keys, kinds))


def describe_object(keys: dict[str, Any], needed: Iterable[str]) -> dict[str, Any]:
    """Return the schema of an object with these keys, and others."""
    return {"type": "object", "properties": keys, "required": sorted(needed)}


def write_schema() -> None:
    """Run the commands and write the schema."""
    with TemporaryDirectory() as folder, chdir(folder):
        documents = [(n, d) for n, d in run_commands() if "$schema" not in d]
    SCHEMA.write_text(json.dumps(build_schema(documents), indent=1) + "\n")


if __name__ == "__main__":
    write_schema()
