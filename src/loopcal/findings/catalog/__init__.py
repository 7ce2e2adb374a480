# SPDX-License-Identifier: Apache-2.0
"""The catalog: the only place where findings are worded, one TOML file for each subject.

    [fit.no-descent]                   # the code
    failure = "The iteration ..."      # severity = text, a template (`loopcal.findings.wording`)
    when = "Every shortened step ..."  # when it is reported, if the text does not say it
    action = "Check for wrong rows."   # what to do next, if the text does not say it
    routine = true                     # left out of short pages, which need not say it
    example = { iterations = 12 }      # data of one case, for tests and documentation

An example is needed where the text depends on its data, and where the data have more than the text
shows. In it, `{ value, unit }` is a `Quantity`, and absent data are empty. An entry is parsed when
its first finding is reported: a command reports a few of them, and a whole file takes 1 to 3 ms.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from loopcal.findings import Severity
from loopcal.findings.wording import Quantity, depends_on_data, fill_template, list_fields

FILES: Mapping[str, tuple[str, ...]] = {
    "workflow": ("gates", "workflow"),
    "fit": ("fit", "prior", "poses", "setup"),
    "residuals": ("noise", "residuals"),
    "values": ("values",),
    "comparison": ("comparison",),
    "run_comparison": ("runs", "checks"),
    "identifiability": ("identifiability", "model"),
    "outliers": ("outliers",),
    "data": ("conventions", "data"),
    "mechanism": ("kinematics", "limits", "singularity", "mechanism"),
    "apply": ("validation", "accuracy", "compensation", "conformity", "repeatability"),
    "sampling": ("sampling",),
    "studies": ("study",),
    "plan": ("plan",),
    "companion": ("companion", "session"),
    "app": ("app",),
    "sheets": ("sheet",),
    "pictures": ("pictures",),
    "study_folders": ("store", "workers"),
    "engine": ("engine",),
    "files": ("files",),
}
"""Files of this folder, in the order of docs/findings.md, and the subjects of their codes."""

_FILE_OF = {subject: file for file, subjects in FILES.items() for subject in subjects}

_ENTRY = re.compile(r"^\[([\w-]+\.[\w-]+)\]", re.MULTILINE)
"""The line with which an entry begins."""


@dataclass(frozen=True)
class Entry:
    """One message of the catalog.

    code : `subject.what`. severity : how much it matters. text : the sentence, a template.
    when : when it is reported. action : what to do next. Both are empty where the text says it.
    example : data of one case. routine : whether short pages leave it out.
    """

    code: str
    severity: Severity
    text: str
    when: str = ""
    action: str = ""
    example: Mapping[str, Any] = field(default_factory=dict)
    routine: bool = False

    def word(self, data: Mapping[str, Any]) -> str:
        """Return the sentence for these data."""
        return fill_template(self.text, **data)

    def word_example(self) -> str:
        """Return the sentence of the example, or the template where data only fill it."""
        if not depends_on_data(self.text):
            return self.text
        return self.word({**dict.fromkeys(self.fields), **self.example})

    @property
    def fields(self) -> frozenset[str]:
        """Names of the data: those of the text and of the example."""
        return list_fields(self.text) | self.example.keys()


@cache
def find_entry(code: str) -> Entry:
    """Return the entry of a code.

    KeyError : the code is not in the catalog.
    """
    subject, _, name = code.partition(".")
    text = _divide_file(_FILE_OF[subject])[code]
    return _make_entry(code, tomllib.loads(text)[subject][name])


def word_phrase(name: str, data: Mapping[str, Any]) -> str:
    """Return a phrase of `phrases.toml` or `phrases.py`, or the text of a code, for these data."""
    if "." in name:
        return find_entry(name).word(data)
    if template := _read_phrases().get(name):
        return fill_template(template, **data)
    return getattr(import_module("loopcal.findings.catalog.phrases"), name)(data)


@cache
def _read_phrases() -> dict[str, str]:
    """Return the templates that several texts share, by name."""
    return {name: _join_lines(text) for name, text in read_document("phrases").items()}


def load_catalog() -> dict[str, Entry]:
    """Return all entries by code."""
    return {code: entry for file in FILES for code, entry in read_entries(file).items()}


@cache
def read_entries(file: str) -> dict[str, Entry]:
    """Return the entries of a file by code."""
    subjects = read_document(file)
    return {
        f"{subject}.{name}": _make_entry(f"{subject}.{name}", keys)
        for subject in FILES[file]
        for name, keys in subjects[subject].items()
    }


def read_document(file: str) -> dict[str, Any]:
    """Return the content of a file: its title, and tables of entries by subject."""
    return tomllib.loads(_read_text(file))


@cache
def _divide_file(file: str) -> dict[str, str]:
    """Return the text of each entry of a file, from the line of its code to the next one."""
    _, *rest = _ENTRY.split(_read_text(file))
    return {code: f"[{code}]\n{text}" for code, text in zip(rest[::2], rest[1::2], strict=True)}


def _read_text(file: str) -> str:
    return Path(__file__).with_name(f"{file}.toml").read_text("utf-8")


def _join_lines(text: str) -> str:
    return " ".join(text.strip().split("\n"))


def _make_entry(code: str, keys: Mapping[str, Any]) -> Entry:
    texts = {name: _join_lines(text) for name, text in keys.items() if isinstance(text, str)}
    (severity,) = texts.keys() - {"when", "action"}
    text = texts.pop(severity)
    example = _convert(keys.get("example", {}))
    return Entry(
        code, Severity(severity), text, **texts, example=example, routine=bool(keys.get("routine"))
    )


def _convert(value: Any) -> Any:
    """Return tuples in place of lists, and quantities in place of tables of value and unit."""
    if isinstance(value, list):
        return tuple(_convert(item) for item in value)
    if isinstance(value, dict):
        if value.keys() == {"value", "unit"}:
            return Quantity(value["value"], value["unit"])
        return {name: _convert(item) for name, item in value.items()}
    return value
