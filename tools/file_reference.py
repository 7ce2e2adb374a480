# SPDX-License-Identifier: Apache-2.0
"""Write the tables of docs/files.md and docs/exports.md from what reads the files: `python -m
tools.file_reference`.

A table stands between `<!-- made by tools.file_reference: NAME -->` and `<!-- end -->`; what is
around it is written by hand.
"""

import dataclasses
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

from loopcal.io.core import file_reference
from loopcal.io.core.records import get_field_types
from loopcal.io.data.columns import RULES
from loopcal.io.data.kind_rows import SETTINGS
from loopcal.io.data.kind_settings import list_kind_settings
from loopcal.io.exports.profile import ColumnSource, ProfileRecord
from loopcal.io.runs.run_folder import MADE_BY
from loopcal.measure import KINDS, Column, Kind
from loopcal.mechanism import FAMILIES, RobotRecord
from loopcal.units import DISPLAY_UNITS, Dimension

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE, EXPORTS = DOCS / "files.md", DOCS / "exports.md"
EXAMPLES = DOCS.parent / "examples" / "exports"
BLOCK = re.compile(
    r"(<!-- made by tools.file_reference: (?P<name>[\w-]+) -->\n)(?P<body>.*?)(<!-- end -->)",
    re.DOTALL,
)


def table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [headers, ["---"] * len(headers), *rows]
    return (
        "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )
        + "\n"
    )


def summarize(record: type) -> str:
    """Return the text of a record's docstring above its sections."""
    text = file_reference.SECTION.split(inspect.cleandoc(record.__doc__ or ""))[0]
    return file_reference.SI.sub("", " ".join(text.split()))


def list_nested_records(record: type) -> tuple[type, ...]:
    """Return the records that a record's keys hold, in order, each once."""
    nested: dict[type, None] = {}

    def walk(annotation: Any) -> Iterator[type]:
        if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
            yield annotation
        for argument in get_args(annotation):
            yield from walk(argument)

    queue = [record]
    while queue:
        for hint in get_field_types(queue.pop(0)).values():
            for inner in walk(hint):
                if inner not in nested and inner is not record:
                    nested[inner] = None
                    queue.append(inner)
    return tuple(nested)


def record_table(record: type, without: Iterable[str] = ()) -> str:
    """Return the keys of a record, those left out that `without` names."""
    left = set(without)
    found = [key for key in file_reference.list_keys(record) if key.name not in left]
    if not any(key.meaning for key in found):
        return (
            "; ".join(
                f"`{k.name}`: {k.holds}" + (f" ({k.default})" if k.default else "") for k in found
            )
            + "\n"
        )
    rows = [(f"`{k.name}`", k.holds, k.default, k.meaning) for k in found]
    return table(("key", "holds", "default", "meaning"), rows)


def common() -> str:
    """Return what every robot file may say."""
    parts = [record_table(RobotRecord)]
    parts += [_nested(record) for record in common_records()]
    return "\n".join(parts)


def common_records() -> tuple[type, ...]:
    """Return the records that several families use."""
    seen: dict[type, int] = {}
    for family in FAMILIES.values():
        for record in list_nested_records(family):
            seen[record] = seen.get(record, 0) + 1
    return tuple(record for record, count in seen.items() if count > 1)


def families() -> str:
    """Return the keys of every family, beside the common ones."""
    shared = [key.name for key in file_reference.list_keys(RobotRecord)]
    parts = []
    for name, family in FAMILIES.items():
        own = [record for record in list_nested_records(family) if record not in common_records()]
        parts.append(
            f"### `family: {name}`\n\n{summarize(family)}\n\n{record_table(family, shared)}"
        )
        parts += [_nested(record) for record in own]
    return "\n".join(parts)


def _nested(record: type) -> str:
    name, summary = file_reference.name_record(record), summarize(record)
    return f"**{name}**: {summary}\n\n{record_table(record)}"


def kinds() -> str:
    """Return columns and settings of every kind of measurement."""
    parts = []
    for name, kind in KINDS.items():
        rows = dict.fromkeys(_example(one) for one in kind.examples())
        columns = table(("settings", "columns", "noise is stated for"), rows)
        meanings = file_reference.collect_meanings(kind)
        if len(possible := kind.allowed_unknown) > 1:
            meanings["unknown"] = (
                f"Which of {', '.join(f'`{p}`' for p in possible)} are unknown, and identified "
                "with the robot"
            )
        settings = table(
            ("setting", "meaning"),
            [(f"`{key}`", meanings.get(key, "")) for key in list_kind_settings(kind)],
        )
        parts.append(f"### `kind: {name}`\n\n{summarize(kind)}\n\n{columns}\n{settings}")
    return "\n".join(parts)


def _example(kind: Kind) -> tuple[str, str, str]:
    """Return settings, columns and noise columns of an example."""
    stated = []
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]  # every kind is a dataclass
        value = getattr(kind, field.name)
        if (
            field.init
            and field.name in ("orientation", "components", "targets", "joints", "form")
            and value
        ):
            stated.append(
                f"`{field.name}: "
                f"{value if isinstance(value, str) else '[' + ', '.join(value) + ']'}`"
            )
    return ", ".join(stated), _columns(kind.columns), _columns(kind.noise_columns)


def _columns(columns: Iterable[Column]) -> str:
    """Return columns with an example of their unit."""
    return " ".join(
        f"`{c.name}`"
        + ("" if c.dimension is Dimension.RATIO else f" [{DISPLAY_UNITS[c.dimension].symbol}]")
        for c in columns
    )


def settings() -> str:
    """Return the settings of a measurement file."""
    return table(("setting", "meaning"), [(f"`{key}`", words) for key, words in SETTINGS.items()])


def columns() -> str:
    """Return the columns of a measurement file."""
    rows = [(f"`{rule.pattern}`", rule.unit, rule.meaning) for rule in RULES]
    return table(("column", "unit", "meaning"), rows)


def provenance_keys() -> str:
    """Return the keys of `made_by`."""
    return table(("key", "meaning"), [(f"`{key}`", words) for key, words in MADE_BY.items()])


def profile() -> str:
    """Return the keys of a profile of exports."""
    return record_table(ProfileRecord)


def profile_columns() -> str:
    """Return the keys of a column in a profile."""
    return record_table(ColumnSource)


def profile_example(name: str) -> Callable[[], str]:
    """Return what gives a profile of the examples."""
    return lambda: f"```yaml\n{(EXAMPLES / name).read_text('utf-8')}```\n"


BLOCKS = {
    "common": common,
    "families": families,
    "kinds": kinds,
    "settings": settings,
    "columns": columns,
    "made-by": provenance_keys,
}
OF_EXPORTS = {"profile": profile, "profile-columns": profile_columns} | {
    name: profile_example(f"{name}.yaml") for name in ("tracker-points", "six-dof", "cmm-spheres")
}


def written(text: str) -> str:
    """Return the page with every table made anew."""
    every = BLOCKS | OF_EXPORTS
    return BLOCK.sub(lambda m: f"{m[1]}{every[m['name']]()}{m[4]}", text)


def main() -> int:
    """Rewrite the pages."""
    for page in (PAGE, EXPORTS):
        page.write_text(written(page.read_text("utf-8")), "utf-8")
        print(f"written: {page.relative_to(DOCS.parent)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
