# SPDX-License-Identifier: Apache-2.0
"""Write the tables of docs/files.md and docs/exports.md from what reads the files: `python -m
tools.file_reference`.

A table stands between `<!-- made by tools.file_reference: NAME -->` and `<!-- end -->`; what is
around it is written by hand.
"""

import dataclasses
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, get_args

from loopcal.io.core.limits import LIMITS
from loopcal.io.core.records import get_field_types
from loopcal.io.data.columns import RULES
from loopcal.io.data.kind_settings import SETTINGS, list_kind_settings
from loopcal.io.exports.profile import ColumnSource, ProfileRecord
from loopcal.io.robot import robot_file as file_reference
from loopcal.io.runs.run_folder import MADE_BY
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.kind import Column, Kind
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.families import FAMILIES
from loopcal.mechanism.families.limbs import Axis
from loopcal.mechanism.families.placement import AngleTolerance, LengthTolerance, RatioTolerance
from loopcal.mechanism.families.records import RobotRecord
from loopcal.studies.files.study_file import LEVELS
from loopcal.studies.specification import Question, Scores, StudySettings, list_columns
from loopcal.units import DISPLAY_UNITS, Dimension
from tools.markdown import fill_blocks, format_table

DOCS = Path(__file__).resolve().parent.parent / "docs"
EXAMPLES = DOCS.parent / "examples" / "exports"
PAGE, EXPORTS = DOCS / "files.md", DOCS / "exports.md"
AXIS = file_reference.describe_type(Axis)
SPREADS = (LengthTolerance, AngleTolerance, RatioTolerance)
WORDS = {
    AXIS: "axis",
    " or ".join(f"`{name}`" for name in AXES): "displacement",
    "[length, length, length]": "point",
    "[0, 0, 0]": "0",
    **{file_reference.name_record(record): "spread" for record in SPREADS},
}
"""What a key holds -> the word that the page explains once."""
Keys = list[file_reference.Key]
SECTIONS = {
    "Scale, temperature and maximum permissible error of an instrument": "scale temperature mpe",
    "Errors that a session shares": "session_bias session_drift",
    "Prior knowledge of instruments": "unknowns",
    "Uncertain readings": "reading_noise",
}
"""Section of the page -> the settings that it describes."""
SHOWN_EXAMPLES = 4  # of a kind
SETUP_PARAMETERS = re.compile(r" Setup parameters: .*")  # the page has a table of all
BLOCK = r"made by tools.file_reference: (?P<name>[\w-]+)"


def summarize(record: type) -> str:
    """Return the text of a record's docstring above its sections."""
    return file_reference.SI.sub("", " ".join(file_reference.split_docstring(record)[0].split()))


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


def format_record(
    record: type, without: Iterable[str] = (), shown: dict[str, Keys] | None = None
) -> str:
    """Return the keys of a record but those that `without` names.

    shown : the keys of the records above, to which this one is added. A record refers to another
    one with which it shares most keys.
    """
    excluded = set(without)
    listed = (key for key in file_reference.list_keys(record) if key.name not in excluded)
    keys = [dataclasses.replace(key, holds=_hold(key), default="") for key in listed]
    sentence, own = refer_to_others(keys, shown or {})
    if shown is not None:
        shown[file_reference.name_record(record)] = keys
    return sentence + format_keys(own)


def refer_to_others(keys: Keys, shown: dict[str, Keys]) -> tuple[str, Keys]:
    """Return a sentence that refers to a record with most of these keys, and the other keys."""
    for name in sorted(shown, key=lambda name: len(set(keys) & set(shown[name])), reverse=True):
        common = set(keys) & set(shown[name])
        names = {key.name for key in keys}
        left_out = [f"`{key.name}`" for key in shown[name] if key.name not in names]
        if len(common) > max(2, len(left_out)):
            without = f" without {', '.join(left_out)}" if left_out else ""
            own = [key for key in keys if key not in common]
            return f"Keys as of **{name}**{without}{', and' if own else '.'}\n\n", own
        break
    return "", keys


def format_keys(keys: Keys) -> str:
    """Return a table of keys, or a list if none has a meaning."""
    rows = merge_rows((f"`{k.name}`", k.holds, k.meaning) for k in keys)
    named = [(f"{names}: {holds}", meaning) for names, holds, meaning in rows]
    if any(key.meaning for key in keys):
        return format_table(("key: value (default)", "meaning"), named)
    return "".join(f"- {key}\n" for key, _ in named)


def merge_rows(rows: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return rows of a table, with one row for all names of which the other cells are equal."""
    names: dict[tuple[str, ...], list[str]] = {}
    for name, *cells in rows:
        names.setdefault(tuple(cells), []).append(name)
    return [(", ".join(equal), *cells) for cells, equal in names.items()]


def _hold(key: file_reference.Key) -> str:
    """Return what a key holds, in the words of the page, and its default."""
    holds = f"{key.holds} ({key.default})" if key.default else key.holds
    for long, word in WORDS.items():
        holds = holds.replace(long, word)
    return holds


def format_common() -> str:
    """Return what every robot file may say."""
    shown: dict[str, Keys] = {}
    sections = [format_record(RobotRecord)]
    sections += [_format_nested(record, shown) for record in list_common_records()]
    return "\n".join(sections)


def list_common_records() -> tuple[type, ...]:
    """Return the records that several families use."""
    nested = (list_nested_records(family) for family in FAMILIES.values())
    counts = Counter(record for records in nested for record in records)
    return tuple(r for r, count in counts.items() if count > 1 and r not in SPREADS)


def format_families() -> str:
    """Return the keys of every family, beside the common ones."""
    shared = [key.name for key in file_reference.list_keys(RobotRecord)]
    common, sections = list_common_records(), []
    shown: dict[str, Keys] = {}
    for record in common:
        format_record(record, shown=shown)
    for name, family in FAMILIES.items():
        records = list_nested_records(family)
        sections.append(f"### `family: {name}`\n\n{format_record(family, shared, shown)}")
        shown[f"family: {name}"] = shown.pop(file_reference.name_record(family))
        own = [record for record in records if record not in (*common, *SPREADS)]
        sections += [_format_nested(record, shown) for record in own]
    return "\n".join(sections)


def _format_nested(record: type, shown: dict[str, Keys] | None = None) -> str:
    name, summary = file_reference.name_record(record), summarize(record)
    return f"**{name}**: {summary}\n\n{format_record(record, shown=shown)}"


def format_kinds() -> str:
    """Return columns and settings of every kind of measurement, common settings once."""
    meanings = {name: _collect_settings(kind) for name, kind in KINDS.items()}
    users: dict[tuple[str, str], list[str]] = {}
    for name, settings in meanings.items():
        for setting in settings.items():
            users.setdefault(setting, []).append(f"`{name}`")
    common = {setting: kinds for setting, kinds in users.items() if len(kinds) > 1}
    several = Counter(key for key, _ in common)
    header = ("setting", "meaning")
    rows = [
        (f"`{key}`" + (several[key] > 1) * f" of {', '.join(kinds)}", words)
        for (key, words), kinds in common.items()
    ]
    sections = [f"### Settings of several kinds\n\n{format_table(header, rows)}"]
    for name, kind in KINDS.items():
        shown: dict[tuple[str, ...], tuple[str, str, str]] = {}  # of equal columns the first
        for example in map(_describe_example, filter(_has_one_target, kind.examples())):
            shown.setdefault(example[1:], example)
        examples = list(shown.values())[:SHOWN_EXAMPLES]
        summary = SETUP_PARAMETERS.sub("", summarize(kind))
        parts = [f"### `kind: {name}`\n\n{summary}\n"]
        if len(examples) > 1:
            parts += [format_table(("settings", "columns", "noise of, if of others"), examples)]
        elif any(examples[0]):
            _, columns, noise = examples[0]
            parts += [f"Columns: {columns}." + f" Noise of {noise}." * bool(noise) + "\n"]
        shared = [f"`{key}`" for key, words in meanings[name].items() if (key, words) in common]
        items = ", ".join(f"`{item}`" for item in kind.allowed_unknown)
        said = [f"Common settings: {', '.join(shared)}."] * bool(shared)
        said += [f"`unknown`: {items}."] * ("," in items)
        parts += [" ".join(said) + "\n"] * bool(said)
        own = merge_rows((f"`{k}`", w) for k, w in meanings[name].items() if (k, w) not in common)
        sections.append("\n".join([*parts, *([format_table(header, own)] if own else [])]))
    return "\n".join(sections)


def _collect_settings(kind: type[Kind]) -> dict[str, str]:
    """Return the meaning of each setting of a kind."""
    meanings = file_reference.collect_meanings(kind)
    settings = {key: _word(meanings.get(key, "")) for key in list_kind_settings(kind)}
    if len(kind.allowed_unknown) > 1:
        settings.pop("unknown", None)  # a line of its own
    return settings


def _word(meaning: str) -> str:
    """Return the meaning of a setting without the shape of its array, as a sentence begins."""
    words = re.sub(r"^\([^)]*\)( \[\w+\])?, ", "", meaning)
    return words if words.startswith("T_") else words[:1].upper() + words[1:]


def _has_one_target(kind: Kind) -> bool:
    """Return whether columns lack the names of targets, which the setting `targets` explains."""
    return len(getattr(kind, "targets", ())) < 2


def _describe_example(kind: Kind) -> tuple[str, str, str]:
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
    columns, noise = _describe_columns(kind.columns), _describe_columns(kind.noise_columns)
    return ", ".join(stated), columns, "" if noise == columns else noise


def _describe_columns(columns: Iterable[Column]) -> str:
    """Return columns with an example of their unit."""
    return " ".join(
        f"`{c.name}`"
        + (
            ""
            if c.dimension in (Dimension.RATIO, Dimension.COUNT)
            else f" [{DISPLAY_UNITS[c.dimension].symbol}]"
        )
        for c in columns
    )


def format_settings() -> str:
    """Return the settings of a measurement file; those with a section are only linked."""
    own = {}
    for title, keys in SECTIONS.items():
        place = title.lower().replace(",", "").replace(" ", "-")
        own |= dict.fromkeys(keys.split(), f"see [above](#{place})")
    rows = merge_rows((f"`{key}`", own.get(key, words)) for key, words in SETTINGS.items())
    return format_table(("setting", "meaning"), rows)


def format_columns() -> str:
    """Return the columns of a measurement file."""
    rows = [(f"`{rule.pattern}`", rule.unit, rule.meaning) for rule in RULES]
    return format_table(("column", "unit", "meaning"), rows)


def format_provenance() -> str:
    """Return the keys of `made_by`."""
    return format_table(("key", "meaning"), [(f"`{key}`", words) for key, words in MADE_BY.items()])


def format_limits() -> str:
    """Return what a file may contain at most."""
    rows = [(limit.of, str(limit)) for limit in LIMITS]
    return format_table(("of", "at most"), rows)


def format_profile() -> str:
    """Return the keys of a profile of exports."""
    return format_record(ProfileRecord)


def format_profile_columns() -> str:
    """Return the keys of a column in a profile."""
    return format_record(ColumnSource)


def format_example(path: Path) -> Callable[[], str]:
    """Return what gives a profile."""
    return lambda: f"```yaml\n{path.read_text('utf-8')}```\n"


def format_study() -> str:
    """Return the keys of a study file, of the levels of its factors, and of its scores."""
    sections = [format_record(StudySettings, without=("scores", "questions"))]
    for name, record in {**LEVELS, "scores": Scores, "questions": Question}.items():
        plain = getattr(record, "PLAIN", None)
        short = f" A plain value is its `{plain}`." if plain else ""
        table = format_record(record, ("coordinates",))
        sections.append(f"### `{name}`\n\n{summarize(record)}{short}\n\n{table}")
        sections += [_format_nested(nested) for nested in list_nested_records(record)]
    return "\n".join(sections)


def format_scores() -> str:
    """Return the columns of the results of trials; root mean square and largest value together."""
    columns = {column.name: column for column in list_columns(Scores(verdict=True))}
    rows = []
    for name, column in columns.items():
        if name.removesuffix("_max") in columns and name.endswith("_max"):
            continue
        unit = "" if column.unit == "1" else f" [{column.unit}]"
        largest = f"{name}_max" in columns
        names = f"`{name}`, `{name}_max`" if largest else f"`{name}`"
        rows.append((names + unit, column.meaning + " and largest" * largest))
    return format_table(("score", "meaning"), rows)


BLOCKS = {
    "common": format_common,
    "families": format_families,
    "kinds": format_kinds,
    "settings": format_settings,
    "columns": format_columns,
    "made-by": format_provenance,
    "limits": format_limits,
    "study": format_study,
    "scores": format_scores,
}
EXPORT_BLOCKS = {
    "profile": format_profile,
    "profile-columns": format_profile_columns,
    "tracker-points": format_example(EXAMPLES / "tracker-points.yaml"),
}


def fill_page(text: str) -> str:
    """Return a page with all of its blocks written anew."""
    writers = BLOCKS | EXPORT_BLOCKS
    return fill_blocks(text, BLOCK, lambda block: writers[block["name"]]())


def main() -> int:
    """Rewrite the pages."""
    for page in (PAGE, EXPORTS):
        page.write_text(fill_page(page.read_text("utf-8")), "utf-8")
        print(f"wrote {page.relative_to(DOCS.parent)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
