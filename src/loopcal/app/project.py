# SPDX-License-Identifier: Apache-2.0
"""The files of one machine in a folder, and the commands that work on them.

    NAME                files as they were given
    result/             what the commands write; robot file and data of a controller's file, too
    plan/, session/     a plan, and the rows that were measured of it or of a given sheet
    choices             what was chosen; files that are given have an ending

Nothing is computed here: commands run as processes of their own (`loopcal.app.work`); the companion
is `loopcal.measuring`, as on the terminal.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from inspect import signature
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from loopcal.app.rows import correct_cell, list_rows
from loopcal.app.work import Said, Work
from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.csv_table import parse_finite, read_template
from loopcal.io.core.limits import UPLOAD_SIZE, UPLOADS, make_name
from loopcal.io.core.text_file import read_json, to_json, write_bytes, write_text
from loopcal.io.data.columns import HELD_OUT
from loopcal.io.data.kind_settings import KindRows
from loopcal.io.exports.growing_export import GrowingExport
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import list_formats, recognize_format
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.io.runs.session_folder import open_session, read_typed
from loopcal.measuring import MeasuringSession, make_pace, prepare_session
from loopcal.planning.companion import CompanionTask
from loopcal.results.notebook import render_html
from loopcal.results.tables import Block, Table
from loopcal.units import parse_goal

LONGEST = 200  # bytes of the name of a file
HEAD = 200_000  # characters by which a file is recognized
STATE, REPORT = "choices", "result/files/report.html"
RUN, SESSION, SHEET = "result/run", "session/measurements.csv", "plan/measurements.csv"
KINDS = ("robot", "data", "log", "closures", "other")  # of files that are no program's
# First bytes of files that are no text in UTF-8 -> what they are.
MARKS = {b"PK\3\4": "archive", b"\x1f\x8b": "archive", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
FIT = ("hold-out", "noise", "loss")  # options of `calibrate`
CHECK_EVERY = CompanionTask.check_every
MEASURE = ("goal", "minutes", "speed", "check-every")  # options of `measure`
QUARTER = "0.25"  # of the poses, held out unless the data or a person say otherwise
OPTIONS = {"length_unit": "unit", "home_height": "home-z"}  # of `import`, with other names
# What an instrument measures -> options of `loopcal plan`.
INSTRUMENTS: Mapping[str, tuple[str, ...]] = {
    "position": ("--kind=position", "--frames=base"),
    "pose": ("--kind=pose", "--frames=base"),
    "distance": ("--kind=distance",),
    "height": ("--measure=z",),
}


def clean_name(name: str) -> str:
    """Return a name of a client as that of a file: without folders and characters with a meaning,
    not hidden, no option, and with an ending, which folders do not have.
    """
    cut = name.encode(errors="ignore")[-LONGEST:].decode(errors="ignore")
    last = re.split(r"[/\\]", make_name(cut))[-1]
    safe = re.sub(r'[<>:"|?*]', "_", last).lstrip(".- ").rstrip(". ")
    if not safe:
        raise DataError.of("app.unnamed")
    safe = safe if Path(safe).suffix else f"{safe}.txt"
    return safe if safe == name else clean_name(safe)


def fits(value: Any, hint: Any) -> bool:
    """Return whether a value of JSON has a type."""
    kind, parts = get_origin(hint) or hint, []
    if isinstance(value, dict | list):
        parts = list(value.values() if isinstance(value, dict) else value)
    is_kind = isinstance(value, kind) and (kind in (bool, str)) == isinstance(value, bool | str)
    return is_kind and all(fits(part, get_args(hint)[-1]) for part in parts)


def check_facts(maker: Callable[..., Any], facts: Any) -> dict[str, Any]:
    """Return what a client or a file says, if it is the arguments of `maker`; else DataError."""
    hints, facts = get_type_hints(maker), facts if isinstance(facts, dict) else {"": facts}
    try:
        signature(maker).bind(**facts)
    except TypeError:
        facts = {"": None}
    if not all(key in hints and fits(value, hints[key]) for key, value in facts.items()):
        raise DataError.of("app.wrong")
    return facts


def read_number(text: str | None, least: float = sys.float_info.min) -> float | None:
    """Return a number that was typed, if there is one; DataError if it is below `least`."""
    number = parse_finite(read_typed(text or "") or "")
    if text and (number is None or number < least):
        raise DataError.of("session.no-number", text=repr(text))
    return number


def check_text(name: str, content: bytes) -> None:
    """Raise FileError for a file that no command reads, with what it is."""
    code = next((code for mark, code in MARKS.items() if content.startswith(mark)), "")
    if code or b"\0" in content or not content.strip():
        code = code or ("binary" if content.strip() else "empty")
        raise FileError.of(f"app.{code}", name)


def recognize(path: Path) -> str:
    """Return the kind of a file: the name of a format, or one of `KINDS`."""
    with path.open(encoding="utf-8", errors="replace") as file:
        head, ending = file.read(HEAD), path.suffix.lower()
    if ending in (".yaml", ".yml") and re.search(r"^family\s*:", head, re.MULTILINE):
        return "robot"
    if name := recognize_format(path, head):
        return name
    if ending == ".csv" and not head.startswith("RepRapFirmware"):
        return "data"
    return "other" if ending in (".yaml", ".yml", ".json") else "log"


@dataclass
class Choices(Said):
    """What people chose, and what commands said. kinds : file -> kind. settings : option -> value.
    dropped : poses that are left out. is_measured : whether the rows of the session are the data.
    runs, edits : number of calibrations, and of changes since the last one.
    """

    kinds: dict[str, str] = field(default_factory=dict)
    settings: dict[str, str] = field(default_factory=dict)
    dropped: list[str] = field(default_factory=list)
    is_measured: bool = False
    runs: int = 0
    edits: int = 0


class Project:
    """The files of one machine; `version` grows when a page is to be drawn again.

    make_export : gives the export that the companion follows, for the kind of a sheet.
    """

    def __init__(
        self, folder: Path, make_export: Callable[[KindRows], GrowingExport] | None = None
    ) -> None:
        self.folder: Path = folder
        self.make_export: Callable[[KindRows], GrowingExport] | None = make_export
        self.version: int = 0
        self.opened: ExitStack[bool | None] = ExitStack()
        if any(folder.iterdir()) and not self.has(STATE):
            raise FileError.of("session.other-content", folder)
        known = read_json(folder / STATE, "choices", "remove it") if self.has(STATE) else {}
        try:
            self.chosen: Choices = Choices(**check_facts(Choices, known))
            kinds = self.chosen.kinds.items()
            is_ours = all(clean_name(n) == n and k in (*KINDS, *FORMATS) for n, k in kinds)
        except DataError:
            is_ours = False
        if not is_ours or any(path.is_symlink() for path in folder.rglob("*")):
            raise FileError.of("app.choices", folder / STATE)
        self.store()
        self.work: Work = Work(folder, self.touch, self.store, self.word)
        self.session: MeasuringSession | None = None
        self.said: list[Block] = []

    def list_files(self, kind: str) -> list[str]:
        """Return the given files of a kind."""
        return [name for name, of in self.chosen.kinds.items() if of == kind]

    def has(self, name: str) -> bool:
        """Return whether a file exists."""
        return (self.folder / name).is_file()

    @property
    def program(self) -> str | None:
        """The file of a controller or another program, if there is one."""
        return next((name for name, kind in self.chosen.kinds.items() if kind not in KINDS), None)

    @property
    def imported(self) -> list[str]:
        """The name, without ending, of what is read from the program's file, if it is used."""
        is_read = self.program and not self.list_files("robot")
        return [f"result/{Path(self.program or '').stem}"] if is_read else []

    @property
    def robot(self) -> str:
        """The robot file, given or read from the program's, or the name of a shipped robot."""
        imported = [f"{name}.yaml" for name in self.imported]
        shipped = set(list_shipped_robots()) & {self.chosen.settings.get("robot")}
        return next(iter([*self.list_files("robot"), *imported, *shipped]), "")

    @property
    def data(self) -> list[str]:
        """The measurement files: of the session, given ones, or those in the program's file."""
        imported = [f"{name}.csv" for name in self.imported]
        return [SESSION] if self.chosen.is_measured else self.list_files("data") or imported

    def add(self, name: str, content: bytes) -> None:
        """Add a file, or replace that of its name."""
        name, kinds = clean_name(name), self.chosen.kinds
        UPLOADS.check(len({*kinds, name}), "page", name)
        check_text(name, content)
        write_bytes(self.folder / name, content)
        kind = recognize(self.folder / name)
        alike = {"robot"} if kind == "robot" else FORMATS.keys() if kind in FORMATS else set()
        before = next((n for n, of in kinds.items() if n != name and of in alike), None)
        reads_macros = kind in FORMATS and "probes" in FORMATS[kind].read_options
        is_macro = before is not None and kinds[before] == kind and reads_macros
        kinds[name] = "log" if is_macro else kind  # such as bed.g beside config.g
        self.chosen.is_measured &= kind != "data"
        self.forget()
        if kind == "other" or (before is not None and not is_macro):
            code = "unused" if before is None else "replaced"
            kinds |= {} if before is None else {before: "other"}
            text = report_finding(f"app.{code}", name=name, before=before)
            self.chosen.messages = [f"loopcal: note: {text}"]
            self.store()

    def change(
        self, kinds: Mapping[str, str] = {}, settings: Mapping[str, str] = {}, remove: str = ""
    ) -> None:
        """Change kinds of files or settings, or remove a file."""
        known = self.chosen.kinds
        known |= {n: k for n, k in kinds.items() if n in known and k in (*KINDS, *FORMATS)}
        self.chosen.settings |= {str(key): str(value) for key, value in settings.items()}
        if known.pop(remove, None):
            (self.folder / remove).unlink(missing_ok=True)
        is_kept = not kinds and not remove and settings.keys() <= {*FIT, *MEASURE}
        self.store(len(settings.keys() & set(FIT))) if is_kept else self.forget()

    def forget(self) -> None:
        """Remove what was made of files that have changed."""
        shutil.rmtree(self.folder / "result", ignore_errors=True)
        self.chosen.dropped, self.chosen.pages, self.chosen.messages = [], {}, []
        self.store()

    def store(self, edits: int = 0) -> None:
        """Keep what was chosen, and `edits` that the result does not contain."""
        self.chosen.edits += edits
        write_text(self.folder / STATE, to_json(asdict(self.chosen)))
        self.touch()

    def touch(self) -> None:
        """Have pages drawn again."""
        self.version += 1

    def word(self, text: object) -> str:
        """Return a text with the names that people gave, in place of files that were made here."""
        shown = str(text).replace(f"{self.folder}{os.sep}", "")
        logs = self.list_files("log") + self.list_files("closures")
        given = self.program or self.robot
        names = {SESSION: "measured rows", SHEET: "sheet of the plan", RUN: given}
        for made in self.imported:
            names |= {f"{made}.yaml": given, f"{made}.csv": ", ".join(logs) or given}
        for made, given in names.items():
            shown = re.sub(rf"{re.escape(made)}(:\d+)?", lambda _, of=given: of, shown)
        return shown

    # Commands: the functions return title -> words of those to run.

    def calibrate(self) -> dict[str, list[str]]:
        """Read the program's file, calibrate, write the report and the corrected file."""
        steps, result, program = self._import(has_data=True), self.folder / "result", self.program
        self.chosen.edits, self.chosen.runs = 0, self.chosen.runs + 1
        for name in ("run", "files"):
            shutil.rmtree(result / name, ignore_errors=True)
        (result / "files").mkdir(parents=True)
        default = {"hold-out": "" if self.program or self._states_held_out() else QUARTER}
        given = [(key, self.chosen.settings.get(key) or default.get(key)) for key in FIT]
        options = [f"--{key}={value}" for key, value in given if value]
        options += [f"--drop={label}" for label in self.chosen.dropped]
        steps["calibrate"] = ["calibrate", self.robot, *self.data, "-o", RUN, *options]
        steps["report"] = ["report", RUN, "-o", REPORT]
        if program and (entry := FORMATS[self.chosen.kinds[program]]).write:
            into = ["--into", program] if entry.takes_file else []
            name = program if entry.takes_file else f"{Path(program).stem}.txt"
            words = ["export", RUN, "--format", entry.name, *into]
            steps["export"] = [*words, "-o", f"result/files/{name}"]
        return steps

    def print_report(self) -> dict[str, list[str]]:
        """Print the report to a PDF file."""
        return {"report": ["report", RUN, "-o", REPORT, "--pdf", "--force"]}

    def _states_held_out(self) -> bool:
        """Return whether measurement files name held-out poses, or cannot be read yet."""
        with suppress(FileError):
            tables = [read_template(self.folder / name) for name in filter(self.has, self.data)]
            return any(HELD_OUT in of.text("use") for of in tables if "use" in of.names)
        return True

    def plan(self, instrument: str, poses: str, accuracy: str, sigma: str) -> dict[str, list[str]]:
        """Plan which poses to measure, unless rows of another plan are there."""
        if (self.folder / "session").exists():
            raise DataError.of("app.measured")
        if instrument not in INSTRUMENTS:
            raise DataError.of("app.wrong")
        options = [*INSTRUMENTS[instrument], f"--sigma-position={sigma}" if sigma else ""]
        options += [f"--accuracy={accuracy}" if accuracy else f"--poses={poses}"]
        words = ["plan", self.robot, "-o", "plan", "--force", *filter(None, options)]
        return {**self._import(has_data=False), "plan": words}

    def _import(self, has_data: bool) -> dict[str, list[str]]:
        """Return the command that reads the program's file, unless it was read."""
        if not self.robot:
            raise DataError.of("app.no-robot")
        if has_data and not self.data:
            raise DataError.of("app.no-data")
        is_inside = has_data and not (self.chosen.is_measured or self.list_files("data"))
        made = [self.robot, *self.data[: int(is_inside)]]
        if not self.program or not self.imported or all(map(self.has, made)):
            return {}
        (self.folder / "result").mkdir(exist_ok=True)
        words = ["import", self.program, "--format", self.chosen.kinds[self.program]]
        words += ["--force", "-o", self.robot]
        words += ["--data", self.data[0]] if is_inside else []
        words += [f"--probes={name}" for name in self.list_files("log")]
        words += [f"--closures={name}" for name in self.list_files("closures")]
        settings = self.chosen.settings
        asked = (key for key in self._list_questions() if settings.get(key))
        words += [f"--{OPTIONS.get(key, key.replace('_', '-'))}={settings[key]}" for key in asked]
        return {"import": words}

    def _list_questions(self) -> list[str]:
        """Return the options of reading the program's file that are no files."""
        kind = self.chosen.kinds.get(self.program or "")
        options = FORMATS[kind].read_options if kind else ()
        return [key for key in options if key not in ("probes", "closures")]

    # Rows

    def list_rows(self, most: int, is_sorted: bool) -> dict[str, Any]:
        """Return the first rows of the measurement files."""
        files = {name: self.folder / name for name in self.data if self.has(name)}
        tables, held_out = list_rows(files, self.folder / RUN, most, is_sorted)
        return {"tables": tables, "held_out": held_out, "dropped": self.chosen.dropped}

    def correct(self, file: str, line: int, column: int, text: str) -> None:
        """Replace a cell of a measurement file."""
        if file not in self.data:
            raise DataError.of("app.gone")
        correct_cell(self.folder / file, line, column, text)
        known = self._list_poses()  # one of them may have another name
        self.chosen.dropped = [each for each in self.chosen.dropped if each in known]
        self.store(edits=1)

    def leave_out(self, pose: str, is_out: bool) -> None:
        """Leave a pose out of the next calibration, or use it again."""
        if pose not in self._list_poses():
            raise DataError.of("app.gone")
        others = [each for each in self.chosen.dropped if each != pose]
        self.chosen.dropped = others + [pose] * is_out
        self.store(edits=1)

    def _list_poses(self) -> set[str]:
        """Return the names of the poses in the measurement files."""
        tables = [read_template(self.folder / name) for name in filter(self.has, self.data)]
        return {label for table in tables for label in table.pose_names()}

    # Measuring

    def measure(self) -> dict[str, list[str]]:
        """Measure the poses of a plan or sheet, or go on; a program's file is to be read first."""
        import loopcal as lc

        sheets = [name for name in (SHEET, *self.list_files("data")) if self.has(name)]
        if not sheets:
            raise DataError.of("app.no-plan")
        if self.session is not None:
            return {}
        if steps := self._import(has_data=False):
            return steps
        robot = lc.load_robot(self.folder / self.robot if self.has(self.robot) else self.robot)
        goal, minutes, speed, check_every = map(self.chosen.settings.get, MEASURE)
        task, table, entry = prepare_session(
            self.folder / sheets[0],
            robot,
            parse_goal(goal) if goal else None,
            make_pace(read_number(minutes), read_number(speed)),
            int(read_number(check_every, least=0.0) or 0) if check_every else CHECK_EVERY,
        )
        columns = [column.name for column in entry.kind.columns]
        with ExitStack() as stack:
            journal = stack.enter_context(open_session(self.folder / "session", table, columns))
            export = self.make_export(entry) if self.make_export else None
            session = MeasuringSession(task, journal, self._say, export)
            session.resume()
            session.choose_pose()
            self.opened, self.session = stack.pop_all(), session
        return {}

    def _say(self, *lines: Block | Finding) -> None:
        self.said += [line if isinstance(line, Table) else self.word(line) for line in lines]

    def tell(self, word: str = "", pose: str = "", values: Sequence[str] = ()) -> None:
        """Take a word, as the terminal does, or the values of a pose."""
        if (session := self.session) is None:
            return
        self.said, columns = [], session.journal.columns
        cells = dict(zip(columns, map(read_typed, values), strict=False))
        wrong = [v for v, cell in zip(values, cells.values(), strict=False) if cell is None]
        if not word and (wrong or len(values) != len(columns)):
            self._say(report_finding("session.no-number", text=repr(next(iter(wrong), ""))))
        elif session.take(word or (pose, {n: cell or "" for n, cell in cells.items()})):
            session.choose_pose()

    def follow(self) -> None:
        """Take the rows that the followed export got."""
        session, said = self.session, self.said
        if session is None or session.export is None:
            return
        self.said = []
        try:
            for row in session.read_export():
                if session.take(row):
                    session.choose_pose()
        except (DataError, FileError) as error:
            self._say(str(error))
        if self.said:
            self.touch()
        else:
            self.said = said

    def finish(self) -> None:
        """End measuring; the used rows become the data of the calibration."""
        self.opened.close()
        self.session, self.chosen.is_measured = None, self.has(SESSION)
        self.forget()

    def discard(self) -> None:
        """End measuring, and remove its rows."""
        self.opened.close()
        shutil.rmtree(self.folder / "session", ignore_errors=True)
        self.finish()

    # What a page shows

    def describe(self) -> dict[str, Any]:
        """Return everything that a page shows, but rows."""
        program, session, shown = self.program, self.session, asdict(self.chosen)
        used = {program, self.robot, *self.data}
        used |= {*self.list_files("log"), *self.list_files("closures")} if self.imported else set()
        shown["unused"] = [name for name in self.chosen.kinds if name not in used]
        shown |= {"robot": self.robot, "data": self.data, "progress": self.work.progress}
        shown |= {"robots": list(list_shipped_robots()), "questions": self._list_questions()}
        shown["formats"] = list_formats("read")
        shown |= {"program": program, "most": UPLOAD_SIZE.count, "session": None}
        shown["is_begun"] = (self.folder / "session").exists()
        shown["downloads"] = [name for name in self.list_downloads() if self.has(name)]
        if session is not None:
            shown["session"] = {
                "pose": None if session.pose is None else session.task.labels[session.pose],
                "command": session.describe_pose(session.pose) if session.pose is not None else [],
                "headers": session.list_headers(),
                "poses": session.task.labels,
                "said": render_html(self.said, style=""),
                "visits": [vars(visit) for visit in session.journal.visits],
            }
        return shown

    def list_downloads(self) -> list[str]:
        """Return the files that can be downloaded, if they exist."""
        made = sorted(path.name for path in (self.folder / "result" / "files").glob("[!.]*"))
        run = ("robot.yaml", "robot-not-calibrated.yaml", "result.json")
        folders = [f"result/files/{name}" for name in made] + [f"{RUN}/{name}" for name in run]
        return [*folders, *self.data, SHEET]
