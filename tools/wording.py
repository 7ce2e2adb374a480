# SPDX-License-Identifier: Apache-2.0
"""Count sentences that readers stumble over, as CONTRIBUTING.md describes.

    python -m tools.wording              counts against their ceilings; fails above one of them
    python -m tools.wording FILE...      lines and sentences of these files, by pattern
    python -m tools.wording --update     write the counts as the new ceilings

The texts: pages (without code, outputs and docs/findings.md), the catalog of findings (each branch
of its templates once), help texts of commands, and all other texts of the source that are not
docstrings. A regular expression finds a pattern: a few of its hits are right English.
"""

from __future__ import annotations

import ast
import json
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from loopcal.findings.wording import parse_template, split_branches
from tools.markdown import fill_blocks, format_table

ROOT = Path(__file__).resolve().parent.parent
CEILINGS = ROOT / "tools" / "wording.json"
"""Group -> pattern -> count at commit 24663bf, ceiling of today."""

PAGE = ROOT / "CONTRIBUTING.md"
"""Page that contains them as a table."""

LONGEST = 25
"""Words of a sentence."""

BE = (
    r"\b(?:is|are|was|were|be|been|being)"
    r"(?: (?:not|also|only|always|never|then|all|already|still|both|\w+ly))?"
)
IRREGULAR = """known given taken shown found made held seen read told written drawn built kept left
lost met chosen driven meant put set run cut thrown born bent understood brought done sent sold"""
NEGATION = r"\b(?:not|no|never|none|neither|cannot|nothing|nobody|without)\b|n't\b"
PLACES = "place point pose position row line file column page frame region part spot poses points"

PATTERNS: Mapping[str, re.Pattern[str]] = {
    name: re.compile(pattern, re.IGNORECASE)
    for name, pattern in {
        f"more than {LONGEST} words": rf"^(?:\S+\s+){{{LONGEST}}}\S",
        "semicolon": ";",
        '"where" for "if"': "".join(f"(?<!{word} )" for word in PLACES.split())
        + r"(?<!know )(?<!shows )(?<!see )(?<!says )(?<!find )\bwhere\b(?! to\b)",
        '", so that"': ", so that",
        '"those of", "that of", "the same"': r"\b(?:those of|that of|the same)\b",
        '"what is"': r"\bwhat (?:is|are|was|were)\b",
        '"of its own"': r"\bof (?:its|their) own\b",
        "two negations": f"(?:{NEGATION}).*(?:{NEGATION})",
        '"is no"': r"\b(?:is|are|was|were) no\b(?! longer| more)",
        '"hardly", "nobody", "beside", "beyond"': r"\b(?:hardly|nobody|besides?|beyond)\b",
        '"state" as a verb': r"(?<!the )(?<!a )(?<!home )(?<!each )(?<!steady )\bstate[sd]?\b",
        "passive voice": rf"{BE} (?:\w+(?<!e)ed|{'|'.join(IRREGULAR.split())})\b",
    }.items()
}

SENTENCE_END = re.compile(r"(?<=[.!?:])[\"')*_]*\s+(?=[\"'(*_`]*[A-Z\d{])")
CODE = re.compile(r"\s*(Examples:|bash |CREATE|BEGIN|SELECT|DELETE|FROM blocks|typeof)")
"""Begin of a text that is commands or SQL."""

ABBREVIATION = re.compile(r"\b(e\.g|i\.e|vs|cf|Eq|Fig|No|et al|approx)\.")


def list_pages(root: Path) -> list[Path]:
    """Return the pages that a person wrote."""
    pages = {root / "README.md", *(root / "examples").rglob("*.md"), *(root / "docs").rglob("*.md")}
    return sorted(pages - {root / "docs" / "findings.md"})


def list_files(root: Path) -> dict[str, list[Path]]:
    """Return the files of each group of texts."""
    source = root / "src" / "loopcal"
    code = sorted(source.rglob("*.py"))
    commands = [p for p in code if "cli" in p.parts] + sorted((source / "cli").rglob("*.toml"))
    catalog = source / "findings" / "catalog"
    return {
        "pages": list_pages(root),
        "catalog": sorted(catalog.iterdir()),
        "commands": commands,
        "other texts": [
            *(p for p in code if p not in commands and p.parent != catalog),
            *sorted((source / "report").glob("*.toml")),
        ],
    }


def list_texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the texts of a file with their lines."""
    if path.suffix == ".md":
        yield from list_paragraphs(path.read_text("utf-8"))
    elif path.suffix == ".toml":
        yield from list_templates(path)
    elif path.suffix == ".py":
        yield from list_strings(ast.parse(path.read_text("utf-8")))


def list_paragraphs(page: str) -> Iterator[tuple[int, str]]:
    """Yield headings, paragraphs, items and cells of a page, without code, comments and links."""

    def blank(match: re.Match[str]) -> str:
        return "\n" * match[0].count("\n")

    page = re.sub(r"^( *)(```+|~~~+|\$\$).*?^ *\2 *$|<!--.*?-->", blank, page, flags=re.M | re.S)
    page = re.sub(r"\$\$.*?\$\$", blank, page, flags=re.S)
    page = re.sub(r"`[^`\n]+`|\$[^$\n]+\$", "X", page)
    page = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", page)
    paragraph, first = "", 0
    for number, line in enumerate([*page.split("\n"), ""], start=1):
        begins = re.match(r"\s*(?:[-*+] |\d+\. |#|\||>|$)", line)
        if begins and paragraph:
            yield first, paragraph
            paragraph = ""
        if line.lstrip().startswith("|"):
            yield from ((number, cell.strip()) for cell in line.split("|") if " " in cell.strip())
        elif line.strip():
            first = first if paragraph else number
            paragraph = f"{paragraph} {line.strip()}".strip()


def list_templates(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the texts of a catalog file, each branch of a template once."""
    text = path.read_text("utf-8")
    phrases = path.with_name("phrases.toml")
    shared = tomllib.loads(phrases.read_text("utf-8")) if phrases.is_file() else {}
    for template in _list_values(tomllib.loads(text)):
        start = text.find(template.strip()[:40].split("\n")[0])
        worded = " ".join(template.split())
        if path.parent.name in ("catalog", "report"):
            variants = {
                fill_branches(worded, shared, branch) for branch in range(_branches(worded))
            }
        else:
            variants = {worded}
        sentences = dict.fromkeys(s for v in sorted(variants) for s in split_sentences(v))
        yield from ((text.count("\n", 0, start) + 1, sentence) for sentence in sentences)


def _list_values(table: Mapping[str, Any]) -> Iterator[str]:
    for key, value in table.items():
        if isinstance(value, dict) and key != "example":
            yield from _list_values(value)
        elif isinstance(value, str) and " " in value:
            yield value


def _branches(template: str) -> int:
    """Return the largest number of branches of a field."""
    numbers = [1]
    for _, _, spec, _ in parse_template(template):
        if "|" in spec:
            _, *branches = split_branches(spec)
            numbers += [len(branches), *map(_branches, branches)]
    return max(numbers)


def fill_branches(template: str, shared: Mapping[str, str], branch: int) -> str:
    """Return a template with one branch of each field, and X for data."""
    words = []
    for text, name, spec, _ in parse_template(template):
        words.append(text)
        if name and "|" in spec:
            rule, *branches = split_branches(spec)
            if rule.startswith("if") and len(branches) == 1:
                branches.append("")
            chosen = branches[min(branch, len(branches) - 1)]
            chosen = re.sub(r"^[\w -]+=", "", chosen) if rule == "choose" else chosen
            words.append(fill_branches(chosen, shared, branch))
        elif name and name.endswith("()") and name[:-2] in shared:
            phrase = " ".join(shared[name[:-2]].split())
            words.append(fill_branches(phrase, shared, branch))
        elif name is not None:
            words.append("X")
    return "".join(words)


def list_strings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the texts of a module that are not docstrings, and docstrings of commands."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            decorators = [] if isinstance(node, ast.Module) else node.decorator_list
            is_command = any("command" in ast.unparse(d) for d in decorators)
            skipped |= {
                id(inner.value)
                for inner in node.body
                if isinstance(inner, ast.Expr)
                and isinstance(inner.value, ast.Constant)
                and not (is_command and inner is node.body[0])
            }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            skipped |= {id(inner) for inner in ast.walk(node) if inner is not node}
            parts = [v.value if isinstance(v, ast.Constant) else "X" for v in node.values]
            text = "".join(str(part) for part in parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        else:
            continue
        if id(node) not in skipped and text.count(" ") >= 2:
            for paragraph in re.split(r"\n\s*\n", text):
                if not CODE.match(paragraph):
                    yield node.lineno, " ".join(paragraph.split())


def split_sentences(text: str) -> list[str]:
    """Return the sentences of a text."""
    return SENTENCE_END.split(ABBREVIATION.sub(lambda m: m[0].replace(".", ""), text))


def find_patterns(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield line, pattern and sentence of each sentence of a file that has a pattern."""
    for line, text in list_texts(path):
        for sentence in split_sentences(text):
            for name, pattern in PATTERNS.items():
                if pattern.search(sentence):
                    yield line, name, sentence


def count_patterns(root: Path) -> dict[str, dict[str, int]]:
    """Return the number of sentences with each pattern, by group of texts."""
    counts = {}
    for group, files in list_files(root).items():
        found = Counter(name for path in files for _, name, _ in find_patterns(path))
        counts[group] = {name: found[name] for name in PATTERNS}
    return counts


def main(arguments: list[str]) -> int:
    """List the patterns of files, or compare all counts with their ceilings."""
    if arguments and arguments[0] not in ("--update", "--before"):
        for path in map(Path, arguments):
            for line, name, sentence in find_patterns(path.resolve()):
                print(f"{path}:{line}: {name}: {sentence}")
        return 0
    if arguments[:1] == ["--before"]:
        counts = count_patterns(Path(arguments[1]))
        limits = {g: {n: [c, c] for n, c in table.items()} for g, table in counts.items()}
        CEILINGS.write_text(write_limits(limits), "utf-8")
        return 0
    counts = count_patterns(ROOT)
    limits = json.loads(CEILINGS.read_text("utf-8"))
    above = 0
    for group, table in counts.items():
        print(group)
        for name, count in table.items():
            before, ceiling = limits[group][name]
            above += count > ceiling
            mark = f", ceiling {ceiling}: reword (python -m tools.wording FILE)"
            print(f"  {name:40} {before:5} -> {count:4}{mark if count > ceiling else ''}")
            limits[group][name] = [before, count]
    if "--update" in arguments:
        CEILINGS.write_text(write_limits(limits), "utf-8")
        page = PAGE.read_text("utf-8")
        PAGE.write_text(fill_blocks(page, "wording", lambda _: write_table(limits)), "utf-8")
        return 0
    return int(above > 0)


def write_table(limits: Mapping[str, Mapping[str, list[int]]]) -> str:
    """Return the counts before and after as a table, one pattern a line."""
    rows = [
        (name, *("{} -> {}".format(*limits[group][name]) for group in limits)) for name in PATTERNS
    ]
    return format_table(("pattern", *limits), rows)


def write_limits(limits: Mapping[str, Mapping[str, list[int]]]) -> str:
    """Return the table of ceilings as JSON, one pattern a line."""
    return re.sub(r"\[\s+(\d+),\s+(\d+)\s+\]", r"[\1, \2]", json.dumps(limits, indent=2)) + "\n"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
