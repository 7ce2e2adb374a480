# SPDX-License-Identifier: Apache-2.0
"""Run evidence/*.py, write docs/evidence/*.json and figures, and make the tables of the
documentation from those files.

Run as `python -m tools.evidence`. `--tables` makes the tables only, `--quick` runs the scripts at
their reduced size, checks what holds there and leaves no file; names choose scripts.
evidence/README.md says what a script returns.
"""

import argparse
import importlib.util
import json
import os
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tools.machine import describe_machine
from tools.markdown import fill_blocks, format_table

ROOT = Path(__file__).resolve().parent.parent
BLOCK = (
    r"evidence: (?P<name>[\w-]+)\.(?P<table>[\w-]+)(?:, (?P<column>[^=>]+) = (?P<value>[^>]+?))?"
    r"(?:, columns to (?P<last>[^>]+?))?(?:, (?P<number>rows|range of|sum of)(?: (?P<of>[^>]+))?)?"
)
"""A table of an evidence file, or its rows with a value in a column, or its columns to one. In a
sentence: the number of these rows "of" all rows, or the range or the sum of a column.
"""


class EvidenceError(Exception):
    """A page that asks for evidence which is not there."""


def collect(script: Path, is_quick: bool = False) -> dict[str, Any]:
    """Run the `collect` function of one evidence script, or `collect` and `check` at its reduced
    size.
    """
    spec = importlib.util.spec_from_file_location(f"evidence_{script.stem}", script)
    if spec is None or spec.loader is None:
        raise ImportError(f"{script} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for the module that defines them
    spec.loader.exec_module(module)
    if not is_quick:
        return module.collect()
    vars(module).update(module.QUICK)
    document = module.collect()
    module.check(document["tables"])
    return document


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write JSON without NaN under a temporary name and rename it, so that a reader never sees half
    a file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)


def write_figures(folder: Path, script: str, figures: dict[str, bytes]) -> list[str]:
    """Write the figures of a script as `SCRIPT-NAME`, remove its other ones, and return the names
    of the files.
    """
    contents = {f"{script}-{name}": content for name, content in sorted(figures.items())}
    for old in find_figures(folder):
        if old.name.startswith(f"{script}-") and old.name not in contents:
            old.unlink()
    for name, content in contents.items():
        temporary = folder / f"{name}.tmp"
        temporary.write_bytes(content)
        temporary.replace(folder / name)
    return list(contents)


def find_figures(folder: Path) -> list[Path]:
    """Return the figures in the folder of the evidence files."""
    return sorted(path for path in folder.iterdir() if path.suffix in (".png", ".svg"))


def run_script(script: Path, folder: Path, is_quick: bool) -> None:
    """Collect one script's evidence, and write its JSON file and its figures into a folder."""
    begin = time.perf_counter()
    document = collect(script, is_quick)
    seconds = round(time.perf_counter() - begin, 1)
    provenance = {
        "script": f"evidence/{script.name}",
        "seconds": seconds,
        "machine": describe_machine(),
    }
    if figures := write_figures(folder, script.stem, document.pop("figures", {})):
        document["figures"] = figures
    write_json(folder / f"{script.stem}.json", {"made": provenance, **document})
    print(f"evidence: {script.stem} took {seconds} s", flush=True)


def run_quickly(scripts: list[Path]) -> None:
    """Run scripts at their reduced size; their tables are those of the full size, with other rows.

    EvidenceError where a table is missing or new. AssertionError where a script's `check` fails.
    """
    with TemporaryDirectory() as place:
        run_all(scripts, Path(place), is_quick=True)
        for script in scripts:
            quick, full = (
                json.loads((folder / f"{script.stem}.json").read_text(encoding="utf-8"))["tables"]
                for folder in (Path(place), ROOT / "docs" / "evidence")
            )
            if quick.keys() != full.keys():
                raise EvidenceError(f"{script.stem} makes the tables {', '.join(quick)}")
            for table in quick.values():
                render_table(table)


def run_all(scripts: list[Path], folder: Path, is_quick: bool) -> None:
    """Run scripts side by side, one on each core; those that took longest the last time begin
    first.

    Each process keeps its linear algebra to one thread, as the command line does: small
    factorisations gain nothing from more, and processes would take the cores from each other.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    ordered = sorted(scripts, key=read_seconds, reverse=True)
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        for done in as_completed(
            [pool.submit(run_script, script, folder, is_quick) for script in ordered]
        ):
            done.result()


def read_seconds(script: Path) -> float:
    """Return how long a script took when its JSON file was made; without one it counts as the
    longest.
    """
    path = ROOT / "docs" / "evidence" / f"{script.stem}.json"
    return (
        json.loads(path.read_text(encoding="utf-8"))["made"]["seconds"]
        if path.exists()
        else float("inf")
    )


def render_table(table: dict[str, Any]) -> str:
    """Return a Markdown table; a missing value is a dash. Above it stand the columns in which
    three rows or more are equal.
    """
    names = table["columns"]
    formats = table.get("formats", [""] * len(names))
    rows = [list(map(_render_cell, row, formats)) for row in table["rows"]]
    columns = list(zip(names, zip(*rows, strict=True), strict=True)) if rows else []
    equal = [(name, cells[0]) for name, cells in columns if len(rows) > 2 and len({*cells}) == 1]
    if not equal:
        return format_table(names, rows)
    own = [(name, cells) for name, cells in columns if (name, cells[0]) not in equal]
    said = ", ".join(f"*{name}* {cell}" for name, cell in equal)
    return f"In all rows: {said}.\n\n" + format_table(
        [name for name, _ in own], zip(*(cells for _, cells in own), strict=True)
    )


def _render_cell(value: Any, spec: str) -> str:
    """Return a cell as text; a word in a column of numbers, such as "diverged", stays a word."""
    if value is None:
        return "-"
    return value if isinstance(value, str) else format(value, spec)


def select_part(table: dict[str, Any], match: re.Match[str]) -> dict[str, Any]:
    """Return the rows of a table with the value that a block names, and its columns to a last
    one.
    """
    if match["column"]:
        at = table["columns"].index(match["column"])
        spec = table.get("formats", {at: ""})[at]
        rows = [r for r in table["rows"] if _render_cell(r[at], spec) == match["value"]]
        table = {**table, "rows": rows}
    if match["last"]:
        end = table["columns"].index(match["last"]) + 1
        kept = {key: table[key][:end] for key in ("columns", "formats") if key in table}
        table = {**kept, "rows": [row[:end] for row in table["rows"]]}
    return table


def render_number(table: dict[str, Any], match: re.Match[str]) -> str:
    """Return the range or the sum of a column, without missing values."""
    at = table["columns"].index(match["of"])
    spec = table.get("formats", {at: ""})[at]
    values = [row[at] for row in table["rows"] if row[at] is not None]
    ends = [sum(values)] if match["number"] == "sum of" else [min(values), max(values)]
    return " to ".join(dict.fromkeys(_render_cell(value, spec) for value in ends))


def fill_tables(text: str, folder: Path) -> str:
    """Return a page with each of its evidence blocks made anew from the JSON files in `folder`.

    EvidenceError where a block names a file or a table that is not there.
    """

    def write(match: re.Match[str]) -> str:
        path = folder / f"{match['name']}.json"
        if not path.exists():
            raise EvidenceError(
                f"there is no {path}; run `python -m tools.evidence {match['name']}` to make it"
            )
        tables = json.loads(path.read_text(encoding="utf-8"))["tables"]
        if match["table"] not in tables:
            raise EvidenceError(
                f"{path} has no table {match['table']!r}; there are {', '.join(tables) or 'none'}"
            )
        table = tables[match["table"]]
        part = select_part(table, match)
        if match["number"] == "rows":
            return f"{len(part['rows'])} of {len(table['rows'])}"
        return render_number(part, match) if match["number"] else render_table(part)

    return fill_blocks(text, BLOCK, write)


def find_pages(root: Path) -> list[Path]:
    """Return the Markdown pages that may hold evidence blocks."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def find_outdated(root: Path) -> dict[Path, str]:
    """Return the pages whose tables differ from the JSON files, with the text they should have."""
    outdated = {}
    for page in find_pages(root):
        text = page.read_text(encoding="utf-8")
        try:
            filled = fill_tables(text, root / "docs" / "evidence")
        except EvidenceError as error:
            raise EvidenceError(f"{page.relative_to(root)}: {error}") from error
        if filled != text:
            outdated[page] = filled
    return outdated


def main(arguments: list[str] | None = None) -> int:
    """Run the scripts and write the tables; return 1 if a page asks for missing evidence."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="evidence/NAME.py scripts to run; all without")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--tables", action="store_true", help="run no script")
    size.add_argument("--quick", action="store_true", help="run scripts at their reduced size")
    options = parser.parse_args(arguments)

    scripts = [ROOT / "evidence" / f"{name}.py" for name in options.names] or sorted(
        (ROOT / "evidence").glob("*.py")
    )
    start = time.perf_counter()
    if not options.tables and not options.quick:
        run_all(scripts, ROOT / "docs" / "evidence", is_quick=False)
    try:
        if options.quick:
            run_quickly(scripts)
        outdated = {} if options.quick else find_outdated(ROOT)
    except EvidenceError as error:
        print(f"evidence: {error}", file=sys.stderr)
        return 1
    for page, text in outdated.items():
        page.write_text(text, encoding="utf-8")
        print(f"evidence: wrote the tables of {page.relative_to(ROOT)}")
    print(f"evidence: {time.perf_counter() - start:.1f} s in total")
    return 0


if __name__ == "__main__":
    sys.exit(main())
