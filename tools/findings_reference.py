# SPDX-License-Identifier: Apache-2.0
"""Write docs/findings.md from the catalog of findings: `python -m tools.findings_reference`.

With `--wording` also write tests/findings/wording.txt, which pins every text of the catalog. Read
its changes before you commit them.
"""

import re
import sys
from pathlib import Path

from loopcal.findings import Severity, catalog
from loopcal.findings.catalog import Entry
from loopcal.findings.wording import depends_on_data, fill_template
from tools.markdown import format_table

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "findings.md"
WORDING = ROOT / "tests" / "findings" / "wording.txt"

SENTENCE_END = re.compile(r"(?<=[.?]) (?=[A-Z`'{]|loopcal)")
PLACEHOLDER = re.compile(r"\{(?P<name>\w+)[^{}]*\}")
WORD = re.compile(r"(?:\*[^*]*\*|`[^`]*`|[^\s*`])+")
SHOWN_WORDS = 5  # of the first sentence of a message
SEVERITIES = {
    Severity.INFO: "worth knowing. The result is usable as it is",
    Severity.SUGGESTION: "a step that would improve the result",
    Severity.WARNING: "check what the text names before you use the result",
    Severity.FAILURE: "do not use the result (exit code 2, or 1 if the command failed). If only a "
    "limit is not met, the values are usable",
    Severity.REFUSAL: "loopcal refused the input before computing",
}
HEAD = """# Findings

<!-- made by tools.findings_reference; `make docs` writes it anew -->

Notes, warnings and refusals are findings. In JSON a finding has `code`, `severity`, `data` and
`text`. Programs read code and data, because the text may change. In Python, results hold
`findings`, `str(finding)` is the text, and an error has the `code` of its finding.

Most messages say what happened and what to do ([all codes](../tests/findings/wording.txt)). This
page has the others: how the message begins, then its condition and what to do. Words in *italics*
stand for data, and texts in quotation marks are examples.
"""


def describe_text(entry: Entry) -> str:
    """Return how a text begins: placeholders in italics, or an example in quotation marks."""
    first = SENTENCE_END.split(entry.word_example(), maxsplit=1)[0]
    if not depends_on_data(entry.text):
        first = PLACEHOLDER.sub(lambda match: f"*{match['name'].replace('_', ' ')}*", first)
    words = WORD.findall(first)
    begin = first if len(words) <= SHOWN_WORDS + 2 else f"{' '.join(words[:SHOWN_WORDS])} ..."
    return f'"{begin}"' if depends_on_data(entry.text) else begin


def describe_circumstances(entry: Entry) -> str:
    """Return when an entry is reported and what to do, as far as its message does not say it."""
    subject, is_suggestion = entry.code.split(".")[0], entry.severity is Severity.SUGGESTION
    is_printed = subject == "study" or (subject == "conventions" and is_suggestion)
    action = "" if is_printed else fill_template(entry.action, **entry.example)
    return f"{entry.when} {action}".strip()


def write_page() -> str:
    """Return docs/findings.md."""
    severities = [(f"`{severity.value}`", words) for severity, words in SEVERITIES.items()]
    sections = [HEAD, format_table(("severity", "meaning"), severities)]
    for file in catalog.FILES:
        entries = [(e, describe_circumstances(e)) for e in catalog.read_entries(file).values()]
        rows = [
            (f"`{e.code}` ({e.severity.value})", f"{describe_text(e)}<br>{circumstances}")
            for e, circumstances in entries
            if circumstances
        ]
        if rows:
            title = catalog.read_document(file)["title"]
            sections += [f"## {title}\n", format_table(("code (severity)", "text"), rows)]
    return "\n".join(sections)


def write_wording() -> str:
    """Return every text of the catalog, one a line: templates as they are, functions by example."""
    lines = [
        f"{e.code} [{e.severity.value}]: {e.word_example()}"
        for e in catalog.load_catalog().values()
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the page, and the wording where asked."""
    PAGE.write_text(write_page(), "utf-8")
    if "--wording" in sys.argv[1:]:
        WORDING.write_text(write_wording(), "utf-8")


if __name__ == "__main__":
    main()
