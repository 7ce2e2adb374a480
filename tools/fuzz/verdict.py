# SPDX-License-Identifier: Apache-2.0
"""What is wrong with the answer to an input: rules that every command keeps, whatever its input.

A find has a signature, which is the same for all inputs that fail in the same way at one place.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.parsers import expat

from loopcal.plain_text import escape
from tools.fuzz.cases import Case
from tools.fuzz.execution import CPU_LIMIT, Outcome

NOT_FINITE = re.compile(r"(?<![\w./+-])[-+]?(?:nan|inf|infinity)(?![\w./-])", re.IGNORECASE)
JSON_NOT_FINITE = re.compile(r"(?<![\w\"])(?:NaN|-?Infinity)(?![\w\"])")
NO_NUMBER = re.compile(r"\b(?:unknown|unbounded|nan|-?inf) (?:[mun]?m|deg|[mu]?rad)\b")
"""A unit behind what is no number: a sentence that was written for numbers."""
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")
FRAME = re.compile(r'File "[^"]*?/src/(loopcal/[^"]+)", line (\d+), in (\S+)')
MESSAGE = re.compile(r"^(loopcal: |Hint: |  )")
ARCHIVES_AND_PICTURES = (b"\x89PNG", b"%PDF", b"PK", b"SQLite format 3")
"""First bytes of files that are no text."""
SECONDS = re.compile(
    r"(?:in|takes|about) [\d.e-]+ s\b|\"(?:worker_)?seconds(?:_per_\w+)?\": [\d.e-]+"
)
"""How long a study took, which differs from run to run."""
LOGS = (".sqlite-shm", ".sqlite-wal")
"""Files that SQLite makes beside a store, also to read it."""


@dataclass(frozen=True)
class Find:
    """A rule that an answer breaks: its name, where or how, and the details."""

    rule: str
    place: str
    detail: str

    @property
    def signature(self) -> str:
        """Rule and place."""
        return f"{self.rule}: {self.place}"


def judge(case: Case, outcome: Outcome, folder: Path) -> list[Find]:
    """Return every rule that the answer to an input breaks."""
    return list({find.signature: find for find in _list_finds(case, outcome, folder)}.values())


def _list_finds(case: Case, outcome: Outcome, folder: Path) -> list[Find]:
    finds = [
        Find("traceback", f"{kind} at {find_place(text)}", text) for kind, text in outcome.failures
    ]
    finds += [Find("warning", text.split("(")[-1].rstrip(")"), text) for text in outcome.warned]
    finds += [Find("escape", text.split(" ")[0], text) for text in outcome.escapes]
    if outcome.cpu > CPU_LIMIT and not outcome.failures:
        finds.append(Find("slow", case.words[0], f"{outcome.cpu:.1f} s of processor time"))
    if outcome.failures:
        return finds
    finds += _judge_message(case, outcome)
    finds += (
        _judge_files(case, outcome) if outcome.code == 1 else _judge_success(case, outcome, folder)
    )
    return finds


def judge_surroundings(case: Case, outcome: Outcome, plain: Outcome) -> list[Find]:
    """Return whether files and variables of other programs changed the answer to an input.

    plain : the outcome without them.
    """
    if any(word in kind for kind, _ in outcome.failures + plain.failures for word in ["TimeIsUp"]):
        return []
    mine = {name: c for name, c in outcome.after.items() if name not in case.foreign}
    folders = {part for name in case.foreign for part in map(str, Path(name).parents)}
    parts = (
        ("exit code", outcome.code, plain.code),
        ("stdout", SECONDS.sub("", outcome.out), SECONDS.sub("", plain.out)),
        ("stderr", outcome.err, plain.err),
        *(
            (f"file {Path(name).suffix}", mine.get(name), plain.after.get(name))
            for name in sorted({*mine, *plain.after} - folders)
            if not name.endswith((*LOGS, ".sqlite"))  # a store states seconds
        ),
    )
    changed = [
        (what, f"{one!r:.400} instead of {two!r:.400}") for what, one, two in parts if one != two
    ]
    by = sorted(k.partition(": ")[2] for k in case.damage if k.startswith("surroundings"))
    return [
        Find("surroundings", f"{case.words[:1]} {what}", f"{by}: {how}") for what, how in changed
    ]


def find_place(text: str) -> str:
    """Return the innermost function of loopcal in a traceback."""
    frames = FRAME.findall(text)
    return f"{frames[-1][0]}:{frames[-1][2]}" if frames else "outside of loopcal"


def _judge_message(case: Case, outcome: Outcome) -> Iterator[Find]:
    """Check the exit code, and that messages are plain lines of the known form."""
    command = case.words[0] if case.words else ""
    if outcome.code not in (0, 1, 2):
        yield Find("exit-code", f"{command} {outcome.code}", outcome.err[-300:])
    lines = outcome.err.splitlines()
    if outcome.code and not lines:
        yield Find("no-message", f"{command} {outcome.code}", outcome.out[-300:])
    is_usage = outcome.err.startswith("Usage:")
    for line in () if is_usage else lines:
        if not MESSAGE.match(line):
            yield Find("message-form", f"{command}: {normalize(line)}", outcome.err[-600:])
            break
    for name, text in (("stderr", outcome.err), ("stdout", outcome.out)):
        if match := CONTROL.search(text):
            near = text[max(match.start() - 60, 0) : match.end() + 20]
            yield Find("control-character", f"{command} {name}: {normalize(near)}", repr(near))
    if outcome.code == 1 and lines and not is_usage and not _names_something(case, outcome.err):
        yield Find("no-name", f"{command}: {normalize(outcome.err)}", outcome.err[-600:])
    if "not enough memory" in outcome.err:
        yield Find("memory", command, outcome.err[-300:])
    if not is_usage and re.search(r"defect of loopcal|Traceback", outcome.err):
        yield Find("defect-message", normalize(outcome.err), outcome.err[-600:])
    said = re.sub(r"'[^'\n]*'", "''", outcome.err + outcome.out)  # without what the input says
    if match := NO_NUMBER.search(said):
        yield Find("no-number", f"{command}: {match[0]}", (outcome.err + outcome.out)[-600:])
    if re.search(r"object at 0x|<class '|NoneType|dtype\(|array\(\[", outcome.err):
        yield Find("internal-words", f"{command}: {normalize(outcome.err)}", outcome.err[-600:])


def _names_something(case: Case, message: str) -> bool:
    """Return whether a message names a file, an option, an argument or a word of the input."""
    said = "".join(line for line in message.splitlines() if not line.startswith("Hint: see "))
    if re.search(r"(?<![\w-])--?[a-z]|Missing argument '|extra argument", said):
        return True
    names = {part for name in case.files for part in (name, Path(name).name)}
    words = {w.lstrip("-") or (f"{w}: " if w else ".") for w in case.words[1:]}  # "" is the folder
    words |= {str(Path(word)) for word in words}  # as a path, "x/" is "x"
    return any(escape(name) in said for name in (names | words))


def normalize(text: str) -> str:
    """Return a text without the numbers and names that differ from input to input."""
    text = re.sub(r"\([^()]*\)", "(..)", text)
    text = re.sub(r"'[^']*'|\"[^\"]*\"", "'..'", text)
    return re.sub(r"[-+]?\d[\d.e+-]*", "0", text)[:70].strip()


def _judge_files(case: Case, outcome: Outcome) -> Iterator[Find]:
    """Check that a command that failed left all files as they were."""
    new = sorted(n for n in set(outcome.after) - set(outcome.before) if not n.endswith(LOGS))
    gone = sorted(set(outcome.before) - set(outcome.after))
    changed = [
        n for n in outcome.before if n in outcome.after and outcome.before[n] != outcome.after[n]
    ]
    for rule, names in (("left-output", new), ("deleted-file", gone), ("changed-file", changed)):
        if names:
            yield Find(rule, case.words[0], f"{names[:6]}: {outcome.err[-400:]}")


def _judge_success(case: Case, outcome: Outcome, folder: Path) -> Iterator[Find]:
    """Check what a command that succeeded printed and wrote."""
    command = case.words[0] if case.words else ""
    texts = (c.decode("utf-8", "replace") for c in case.files.values() if isinstance(c, bytes))
    said = " ".join([*case.words, *texts])
    may_name = bool(NOT_FINITE.search(said))
    if JSON_NOT_FINITE.search(outcome.out) if "--json" in case.words else (
        not may_name and NOT_FINITE.search(outcome.out)
    ):  # fmt: skip
        match = NOT_FINITE.search(outcome.out)
        near = outcome.out[max(match.start() - 80, 0) : match.end() + 40] if match else ""
        yield Find("non-finite", f"{command} stdout", near)
    for name in sorted(outcome.before):
        if name not in outcome.after and not name.startswith(tuple(_outputs(case))):
            yield Find("deleted-file", command, name)
    copies = _list_copies(outcome)
    for name, content in outcome.after.items():
        if isinstance(content, bytes) and content not in copies and not name.endswith(LOGS):
            yield from _judge_output(case, name, content, may_name)
    if outcome.code == 0 and "--help" not in case.words and "-h" not in case.words:
        for name in _outputs(case)[:1]:
            is_list = case.words[:1] == ["example"] and len(case.words) == 3  # no name is given
            if not is_list and not (folder / name).exists():
                yield Find("missing-output", command, name)
    yield from judge_readable(case, outcome, folder)


def _list_copies(outcome: Outcome) -> set[bytes | str]:
    """Return the content of all inputs, which an output may repeat as it is."""
    return set(outcome.before.values())


def _outputs(case: Case) -> list[str]:
    """Return the last name that follows -o or --output, which is the one that counts."""
    words = case.words
    named = [b for a, b in pairwise(words) if a in ("-o", "--output")]
    return named[-1:]


def _judge_output(case: Case, name: str, content: bytes, may_name: bool) -> Iterator[Find]:
    """Check one file that was written: it is text or a picture, and its numbers are finite."""
    kind = Path(name).suffix
    command = case.words[0]
    if content.startswith(ARCHIVES_AND_PICTURES):
        return
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        yield Find("unreadable", f"{command} {kind}: not UTF-8", f"{name}: {error}")
        return
    if not text:
        yield Find("unreadable", f"{command} {kind}: empty", name)
    pattern = JSON_NOT_FINITE if kind == ".json" else NOT_FINITE
    if text.startswith(("/*", "component ")):  # C, whose comments may speak of NaN
        return
    if (kind == ".json" or not may_name) and (match := pattern.search(text)):
        near = text[max(match.start() - 80, 0) : match.end() + 40]
        yield Find("non-finite", f"{command} {kind}", f"{name}: {near}")
    if kind == ".json" and re.match(r"\{|\[(?![A-Z])", text):  # tables and .ini may have any name
        try:
            json.loads(text)
        except ValueError as error:
            yield Find("unreadable", f"{command} {kind}: {error}"[:90], name)
    if kind == ".svg" and text.startswith("<"):
        try:
            expat.ParserCreate().Parse(content, True)
        except expat.ExpatError as error:
            yield Find("unreadable", f"{command} {kind}", f"{name}: {error}")


def judge_readable(case: Case, outcome: Outcome, folder: Path) -> Iterator[Find]:
    """Check that loopcal reads every robot file, measurement file and run that it wrote."""
    from tools.fuzz.reading import read_back

    copies = _list_copies(outcome)
    new = {n for n, content in outcome.after.items() if content not in copies}
    for name, sentence, place in read_back(case, new, outcome.after, folder):
        if "data.outside-stroke" in place:  # of a sheet that is filled in, which may be wrong
            continue
        yield Find("unreadable", f"{case.words[0]}: {place}", f"{name}: {sentence}")
