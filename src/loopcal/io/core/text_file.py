# SPDX-License-Identifier: Apache-2.0
"""Text in and out of the file system: UTF-8 only, written whole or not at all, one sentence when it
fails.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from loopcal.errors import FileError

BOM = "\ufeff"


def read_text(path: str | Path, what: str, otherwise: str = "") -> str:
    """Return the text of a UTF-8 file; a byte order mark at its start is dropped.

    Parameters
    ----------
    path : str or Path
        The file.
    what : str
        What the file should be, for messages: "robot file", "measurement file".
    otherwise : str
        What else than saving it as UTF-8 helps; closes the message.

    Raises
    ------
    FileError
        No such file, a folder, no permission, not UTF-8, or nothing in it.
    """
    path, raw = Path(path), read_raw(path, what)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{raw[error.start]:02x}"
        raise FileError(
            f"this {what} is not UTF-8 text ({found}); save it as UTF-8{otherwise}", path, line
        ) from None
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise FileError(
            f"this {what} holds a zero byte, so it is not UTF-8 text; save it as UTF-8{otherwise}",
            path,
            line,
        )
    if not text.strip():
        raise FileError(
            f"this {what} is empty; see the examples that come with loopcal for what it should hold",
            path,
        )
    return text


def read_raw(path: str | Path, what: str) -> bytes:
    """Return the bytes of a file; `what` it should be is for messages.

    Raises
    ------
    FileError
        No such file, a folder, no permission.
    """
    path = Path(path)
    if path.is_dir():
        raise FileError(f"this is a folder where a {what} is needed; name the file inside it", path)
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise FileError(f"there is no such {what}; check the name and the folder", path) from None
    except OSError as error:
        raise FileError(
            f"this {what} cannot be read ({_reason(error)}); check its permissions", path
        ) from error


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text.

    Raises
    ------
    FileError
        The file cannot be read.
    """
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise FileError(
            f"this file cannot be read ({_reason(error)}); check its name and permissions", path
        ) from error


def target_of(path: str | Path) -> Path:
    """Return the file that is written where `path` is: itself, or what a symbolic link names.

    Raises
    ------
    FileError
        There is something else than a file: a folder, a device, a pipe, a link that ends nowhere.
    """
    path = Path(path)
    if path.is_dir():
        raise FileError(
            "this is a folder where a file name is needed; add the name of the file to write", path
        )
    if path.exists() and not path.is_file():
        raise FileError(
            "this is a device or a pipe, which would be replaced by a file; choose the name of a "
            "file",
            path,
        )
    if not path.is_symlink():
        return path
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        raise FileError("this symbolic link ends nowhere; choose another name", path) from None


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 file whole or not at all: to a temporary name beside it, then renamed over it.

    A symbolic link stays one; the file that it names is written.

    Raises
    ------
    FileError
        The path is a folder or no file, its folder is missing, no permission, or the disk is full.
    """
    target = target_of(path)
    with report_write_errors(path):
        temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
        try:
            with temporary.open("w", encoding="utf-8", newline="\n") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def report_write_errors(path: str | Path) -> Iterator[None]:
    """Turn every failure of the file system while writing `path` into one sentence.

    Raises
    ------
    FileError
        In place of any OSError of the body.
    """
    try:
        yield
    except FileNotFoundError:
        folder = Path(path).parent
        raise FileError(
            f"this cannot be written because there is no folder {folder}; make it first", path
        ) from None
    except OSError as error:
        raise FileError(
            f"this cannot be written ({_reason(error)}); choose another place", path
        ) from error


def _reason(error: OSError) -> str:
    """Return the operating system's own words, in lower case."""
    return (error.strerror or type(error).__name__).lower()
