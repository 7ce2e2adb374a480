# SPDX-License-Identifier: Apache-2.0
"""Markdown: tables, and blocks of a page that a program writes."""

import re
from collections.abc import Callable, Iterable, Sequence


def format_table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    lines = [headers, ["---"] * len(headers), *rows]
    escaped = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in escaped)


def find_blocks(text: str, begin: str) -> list[re.Match[str]]:
    """Return the blocks of a page between the comments `begin` and `end`.

    `begin` is a regular expression with groups for what the block contains.
    """
    return list(_compile(begin).finditer(text))


def fill_blocks(text: str, begin: str, write: Callable[[re.Match[str]], str]) -> str:
    """Return a page with the body of each block written anew from its match."""
    return _compile(begin).sub(lambda block: f"{block['begin']}{write(block)}<!-- end -->", text)


def _compile(begin: str) -> re.Pattern[str]:
    return re.compile(f"(?P<begin><!-- {begin} -->\\n?).*?<!-- end -->", re.DOTALL)
