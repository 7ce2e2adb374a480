# SPDX-License-Identifier: Apache-2.0
"""Damaged files of other programs are refused by name, or read as a robot of finite numbers."""

import json
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loopcal.errors import LoopcalError
from loopcal.io.exports.conversion import convert_export, save_converted
from loopcal.io.exports.profile import read_profile
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import export_robot, save_imported
from loopcal.io.formats.probe_reports import read_reports
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from tests.io.changed_documents import change_value, list_places
from tools.fuzz.sources import SOURCES

DIGITS = "0" * 5000
"""More digits than Python turns into a whole number."""
MOST = {"urdf": 4, "sdf": 3, "mjcf": 3, "hangprinter": 4}
"""Places of each sort of damage, for files that are slow to read; 6 for others, twice as many in
the evidence.
"""

NUMBERS = ("1e300", "-1e160", "0", "-1", "nan", "inf", "x", "", "1,5", "1_0", "\uff11", "9" * 400)
NUMBERS += ("1e400", "1e12", f"{DIGITS}1", f"0e{DIGITS}1")
TEXTS = ("1e-320", "+5", "1e5", "'", "[", "#", ";", "\t", "\u202e", "=1+1", "{}", "*a")
WRONG = (..., {}, [], [None], "x", 1e300, -1e160, None, True, [[1]], 0, 10**400)
LINE_ENDS = ("\r\n", "\r", "\n\r", "\x0b", "\x0c", "\x85", "\u2028", " \n", "\n\n")
ENCODINGS = ("utf-16", "utf-32-le", "utf-8-sig", "latin-1", "cp1252")
FILES = {
    "klipper": "printer.cfg",
    "marlin": "marlin.g",
    "reprap": "robot.g",
    "linuxcnc": "hexapod.hal",
    "urdf": "robot.urdf",
    "sdf": "robot.sdf",
    "mjcf": "robot.xml",
    "hangprinter": "samples.json",
}


def choose(items: Sequence[Any], most: int) -> Sequence[Any]:
    """Return items that are spread over the list."""
    return items[:: max(1, len(items) // most)]


def damage(text: str, most: int = 12) -> Iterator[bytes]:
    """Yield damaged versions of a text; `most` places of each sort."""
    raw = text.encode()
    yield from (raw[:place] for place in choose(range(len(raw)), most))
    numbers = list(re.finditer(r"-?\d+(\.\d+)?", text))
    for match, value in zip(choose(numbers, most), cycle(NUMBERS + TEXTS), strict=False):
        yield f"{text[: match.start()]}{value}{text[match.end() :]}".encode()
    yield re.sub(r"(?<![\d.])(?=\d)", DIGITS, text).encode()
    yield re.sub(r"(?<=\.\d\d)(?=[\s\"])", f"e{DIGITS}", text).encode()
    lines = text.splitlines(keepends=True)
    for place in choose(range(len(lines)), most // 3):
        yield "".join([*lines[:place], *lines[place + 1 :]]).encode()
        yield "".join([*lines[: place + 1], *lines[place:]]).encode()
        yield "".join([*lines[place:], *lines[:place]]).encode()
    for end in LINE_ENDS:
        yield text.replace("\n", end).encode()
    for encoding in ENCODINGS:
        yield f"; # \u00e9\n{text}".encode(encoding, "replace")
    yield from (b"\0" + raw, raw.replace(b".", b"\0", 1), raw + b"\xff", b"", b"\n", raw * 2)


def damage_json(text: str) -> Iterator[bytes]:
    """Yield versions of JSON text with one wrong value, and with a key twice."""
    document = json.loads(text)
    for place, value in zip(list_places(document), cycle(WRONG), strict=False):
        yield json.dumps(change_value(document, place, value)).encode()
    for key in document:
        yield f'{{"{key}": 1, {text[1:]}'.encode()


@pytest.fixture
def files(tmp_path, root, monkeypatch) -> Path:
    """Return the current folder with an intact file of each format."""
    for name, text in SOURCES.items():
        (tmp_path / name).write_text(text)
    shutil.copy(root / "examples" / "cable-robot" / "samples.json", tmp_path)
    for path in (root / "examples" / "exports").iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def import_file(name: str, path: Path) -> None:
    """Read a file, write its robot and measurements, and correct a copy of the file."""
    known = FORMATS[name]
    closures = Path("loops.yaml") if name == "urdf" else None
    options = ImportOptions("r", length_unit="mm", home_height=0.2, closures=closures)
    assert known.read is not None
    with np.errstate(all="raise", under="ignore"):
        imported = known.read(path, options)
        data = None if imported.measurements is None else Path("out.csv")
        robot = save_imported(path, imported, Path("out.yaml"), data)
        assert np.isfinite(robot.values).all()
        if known.write is None or not known.takes_file:
            return
        exported = export_robot(ExportSource(robot), known, path)
    path.write_bytes(exported.text.encode())
    known.read(path, options)


def try_damages(
    damages: Iterator[bytes], path: Path, read: Callable[[Path], object], *beside: str
) -> tuple[int, int]:
    """Return how many damaged files are refused, and how many there are; anything else fails.

    An error names the file, or another one `beside` it that is read together with it.
    """
    refused = total = 0
    for content in damages:
        path.write_bytes(content)
        total += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                read(path)
        except LoopcalError as error:
            refused += 1
            is_named = str(error).startswith((str(path), "out.", "loops.yaml", *beside))
            if not is_named or "defect" in str(error):
                raise AssertionError(f"{error} with {content!r}") from error
        except Exception as error:
            raise AssertionError(f"{type(error).__name__}: {error} with {content!r}") from error
    return refused, total


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("times", [1, pytest.param(2, marks=pytest.mark.evidence)])
def test_a_damaged_file_is_refused_or_read(files, name: str, times: int) -> None:
    path = Path(FILES[name])
    text = path.read_text()
    if name == "hangprinter":  # fewer digits, as many numbers
        text = json.dumps(json.loads(text))
    read = lambda file: import_file(name, file)  # noqa: E731
    read(path)
    refused, total = try_damages(damage(text, times * MOST.get(name, 4)), path, read)
    assert total > 30
    assert refused > 0.3 * total


def test_a_damaged_document_is_refused_or_read(files) -> None:
    text = json.dumps(json.loads(Path("samples.json").read_text()))
    damages = damage_json(text)
    refused, total = try_damages(damages, Path("s.json"), lambda f: import_file("hangprinter", f))
    assert refused > 0.5 * total


HEIGHT_MAP = """\
RepRapFirmware height map file v2
axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1
X,Y,-10,10,-10,10,-1,20,20,2,2
0.1,0.2
0.3,-0.4
"""
PROBED = "Bed X:1.00 Y:-2.00 Z:0.30\nok\n"
POINTS = "G30 P0 X1.0 Y2.0 Z-99999\nG30 P1 X-1.0 Y2.0 Z-99999\n"
REPORTS = {
    "marlin": (
        f"{PROBED}Checking... AC at radius:50 (DRY-RUN)\n.c:+0.10 x:-0.20 y:0.30\n.Height:250\n",
        "X:1.00 Y:2.00 Z:3.00 E:0 Count X:1\n",
    ),
    "reprap": (
        HEIGHT_MAP,
        f"{POINTS}G32 bed probe heights: 0.1 -0.2, mean 0, deviation 0\n",
        "G1 X1.0 Y-2 F600\nG30 S-1\nStopped at height 2.4 mm\n",
    ),
}


@pytest.mark.parametrize(("firmware", "text"), [(f, t) for f in REPORTS for t in REPORTS[f]])
def test_a_damaged_report_of_probed_points_is_refused_or_read(files, firmware, text) -> None:
    """Also one that states more points, or larger numbers of points, than memory holds."""
    path = Path("report.txt")

    def read(path: Path) -> None:
        points, _ = read_reports([path], firmware, {"X": 0.0, "Y": 0.0, "Z": 2.1})
        assert np.isfinite([point[:3] for point in points]).all()
        assert len(points) <= 10

    path.write_text(text)
    read(path)
    damages = (damage(text, most) for most in (6, 20, 50))
    refused, total = try_damages(chain.from_iterable(damages), path, read)
    assert 0 < refused < total


@pytest.mark.parametrize("value", ["255", "x", True, False, [255], None, {}])
def test_a_number_of_samples_is_no_text_and_no_truth_value(files, value) -> None:
    document = json.loads(Path("samples.json").read_text())
    del document["_source"]
    document["anchors"] = [[0.0, -1000.0, 0.0]] * 4
    innermost = {place[0]: place for place in list_places(document)}
    assert len(innermost) == 8
    for key, place in innermost.items():
        Path("s.json").write_text(json.dumps(change_value(document, place, value)))
        with pytest.raises(LoopcalError, match=str(key)):
            import_file("hangprinter", Path("s.json"))


def convert(profile: Path, export: Path) -> None:
    """Convert an export, and write the measurement file."""
    save_converted(convert_export(export, read_profile(profile)).text, "out.csv")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tracker-points", "cmm-spheres", "six-dof"])
@pytest.mark.parametrize("is_profile", [False, True])
@pytest.mark.parametrize("most", [6, pytest.param(12, marks=pytest.mark.evidence)])
def test_a_damaged_export_or_profile_is_refused_or_read(
    files, name: str, is_profile, most: int
) -> None:
    profile = Path(f"{name}.yaml")
    export = next(path for path in (Path(f"{name}.txt"), Path(f"{name}.csv")) if path.exists())
    damaged = Path("damaged.yaml" if is_profile else "damaged.txt")
    text = (profile if is_profile else export).read_bytes().decode("utf-8-sig", "replace")
    if is_profile:
        refused, total = try_damages(
            damage(text, most), damaged, lambda file: convert(file, export), export.name
        )
    else:
        refused, total = try_damages(
            damage(text, most), damaged, lambda file: convert(profile, file), profile.name
        )
    assert total > 30
    assert refused > 5
