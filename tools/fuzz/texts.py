# SPDX-License-Identifier: Apache-2.0
"""Damage to lines, numbers and bytes of a file of any format."""

from __future__ import annotations

import re
from collections.abc import Callable
from random import Random

from tools.fuzz.values import CELLS, NAMES, SNIPPETS, WINDOWS_PATHS, change_number

NUMBER = re.compile(rb"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")
WORD = re.compile(rb"[A-Za-z_][\w.-]*")

TAILS = (
    b"\x00",
    b"\xff\xfe",
    b"# end",
    b"\n...",
    b"\n---\n",
    b"\nx: |\n  text",
    b"\n\n\n",
    b" ",
    b"\t",
    b"\x1a",
    b"\n#",
)
"""Ends of a file."""


TAGS = (
    *("!!bool", "!!int", "!!float", "!!set", "!!omap", "!!pairs", "!!binary", "!!timestamp"),
    *("!!null", "!!str", "!!seq", "!!map", "!!merge", "!", "!x", "!<tag:yaml.org,2002:int>"),
    *("!!python/object/apply:os.getcwd", "!!python/name:os.system", "!!ruby/object:x", "!e!x"),
)
"""Tags of YAML, with types that its readers know and with others."""

DIRECTIVES = ("%YAML 1.1", "%YAML 1.2", "%YAML 9.9", "%TAG ! tag:x:", "%TAG !! tag:y:", "%X y")
"""Lines that begin a document of YAML."""

LINE_ENDS = (b"\r\n", b"\r", b"\n\r", b"\r\r\n", b"\x0b", b"\x0c", b"\xc2\x85", b"\xe2\x80\xa8")
"""What other systems and programs write between two lines, and what Python takes for it."""


def mutate_text(content: bytes, rng: Random) -> tuple[bytes, str]:
    """Return a damaged copy of a file, and the name of the damage."""
    name = rng.choice(list(MUTATIONS))
    return MUTATIONS[name](content, rng), name


def _change_number(content: bytes, rng: Random) -> bytes:
    """Replace a number of the text."""
    matches = list(NUMBER.finditer(content))
    if not matches:
        return content
    match = rng.choice(matches)
    if rng.random() < 0.5:
        new = repr(change_number(float(match[0]), rng))
    else:
        new = rng.choice(CELLS)
    return content[: match.start()] + new.encode() + content[match.end() :]


def _change_word(content: bytes, rng: Random) -> bytes:
    """Replace a word of the text by a name, by another word of the text, or by a piece of YAML."""
    matches = list(WORD.finditer(content))
    if not matches:
        return content
    match = rng.choice(matches)
    new = rng.choice(
        [rng.choice(NAMES).encode(), rng.choice(matches)[0], rng.choice(SNIPPETS).encode()]
    )
    return content[: match.start()] + new + content[match.end() :]


def _edit_lines(content: bytes, rng: Random) -> bytes:
    """Delete, repeat, move or join lines."""
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(5):
        case 0:
            del lines[i]
        case 1:
            lines.insert(j, lines[i])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
        case 3:
            lines[i] = lines[i].rstrip(b"\r\n")
        case _:
            del lines[min(i, j) : max(i, j) + 1]
    return b"".join(lines)


def _insert_line(content: bytes, rng: Random) -> bytes:
    """Insert a line with a piece of YAML, a name or a comment."""
    lines = content.splitlines(keepends=True)
    new = rng.choice(
        [
            f"{rng.choice(NAMES)}: {rng.choice(SNIPPETS)}",
            rng.choice(SNIPPETS),
            rng.choice(NAMES),
            "# " + "x" * rng.choice([10, 5000]),
            ",".join(rng.choice(CELLS) for _ in range(rng.choice([1, 4, 400]))),
        ]
    )
    lines.insert(rng.randrange(len(lines) + 1), new.encode() + b"\n")
    return b"".join(lines)


def _truncate(content: bytes, rng: Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _flip_bytes(content: bytes, rng: Random) -> bytes:
    changed = bytearray(content)
    for _ in range(min(rng.choice([1, 1, 3, 20]), len(changed))):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def _insert_bytes(content: bytes, rng: Random) -> bytes:
    i = rng.randrange(len(content) + 1)
    new = rng.choice(
        [
            b"\x00",
            b"\xff",
            b"\xc3",
            b"\x1b[2J",
            b"\r",
            b"\n",
            b'"',
            b"'",
            b"\t",
            b"\xe2\x80\xae",
            b",",
            b"#",
        ]
    )
    return content[:i] + new + content[i:]


def _encode(content: bytes, rng: Random) -> bytes:
    """Write the text in another encoding, with other line ends, or with a byte order mark."""
    text = content.decode("utf-8", "replace")
    return rng.choice(
        [
            b"\xef\xbb\xbf" + content,
            content.replace(b"\n", b"\r\n"),
            content.replace(b"\n", b"\r"),
            text.encode("utf-16"),
            text.encode("latin-1", "replace"),
            content.rstrip(b"\n"),
            content.replace(b" ", b"\t"),
            content.replace(b".", b","),
            content.replace(b",", b";"),
            content.upper(),
            b"",
            b"\n",
        ]
    )


def _tag(content: bytes, rng: Random) -> bytes:
    """Write a tag before a value, or a directive above a document."""
    remark = b"# " if content.startswith(b"# ") else b""
    if rng.random() < 0.2:
        line = rng.choice(DIRECTIVES).encode() + rng.choice([b"\n", b"\n" + remark + b"---\n"])
        return remark + line + content
    matches = list(VALUE.finditer(content))
    if not matches:
        return content
    at = rng.choice(matches).end()
    value = rng.choice([b"", b'""', b"p ", b"_ ", b"x\n"])
    return content[:at] + rng.choice(TAGS).encode() + b" " + value + content[at:]


VALUE = re.compile(rb"(?:: |- |\[|, )(?=\S)")
"""What stands before a value of YAML."""


def _change_line_ends(content: bytes, rng: Random) -> bytes:
    """Write other line ends: all of them, or some."""
    end, share = rng.choice(LINE_ENDS), rng.choice([1.0, 1.0, 0.5, 0.1])
    lines = content.split(b"\n")
    return (
        b"".join(line + (end if rng.random() < share else b"\n") for line in lines[:-1]) + lines[-1]
    )


def _write_windows_path(content: bytes, rng: Random) -> bytes:
    """Replace a name of a file or a word by a path of Windows."""
    matches = list(FILE.finditer(content)) or list(WORD.finditer(content))
    if not matches:
        return content
    match = rng.choice(matches)
    return content[: match.start()] + rng.choice(WINDOWS_PATHS).encode() + content[match.end() :]


FILE = re.compile(rb"[\w./-]+\.(?:csv|yaml|json|txt|npz)\b")


def _append(content: bytes, rng: Random) -> bytes:
    return content.rstrip(b"\n") * (rng.random() < 0.95) + rng.choice(TAILS)


def _repeat(content: bytes, rng: Random) -> bytes:
    return content * rng.choice([2, 3])


MUTATIONS: dict[str, Callable[[bytes, Random], bytes]] = {
    "number": _change_number,
    "word": _change_word,
    "lines": _edit_lines,
    "insert-line": _insert_line,
    "truncate": _truncate,
    "flip": _flip_bytes,
    "insert-bytes": _insert_bytes,
    "encoding": _encode,
    "append": _append,
    "twice": _repeat,
    "tag": _tag,
    "line-ends": _change_line_ends,
    "windows-path": _write_windows_path,
}
