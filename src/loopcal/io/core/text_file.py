# SPDX-License-Identifier: Apache-2.0
"""Text and JSON files: UTF-8 only, written whole or not at all, one sentence for every failure.

JSON has no NaN: numbers that are not finite become null, with the reason under `nulls`.

Files and folders take a name only when they are complete. New content has a temporary name beside
its target, such as `.loopcal-new-0123456789abcdef-run`. It is created exclusively, and locked as
long as its writer lives. An old folder, also locked, is first set aside as
`.loopcal-old-0123456789abcdef-run`, for the moment between two renames. What a killed writer leaves
behind has such a name and no lock. The next write to the target returns a folder that was set aside
to its name, and removes the rest if it is loopcal's.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from loopcal.errors import DataError, FileError, LoopcalError, MissingPackageError
from loopcal.io.core.limits import JSON_DEPTH, JSON_VALUES, PROGRAM_SIZE, FileLimit
from loopcal.output_record import identify, note_output, record_outputs, was_free
from loopcal.plain_text import escape_json
from loopcal.results import serialization

# Open files and folders: locks, identity, and writing to the disk.

try:
    import fcntl
except ImportError:  # Windows: no locks, so leftovers are never removed
    fcntl = None


Descriptor = TypeVar("Descriptor", int, int | None)


@contextmanager
def _opened(descriptor: Descriptor) -> Iterator[Descriptor]:
    """Close a descriptor, where there is one, behind the body."""
    try:
        yield descriptor
    finally:
        if descriptor is not None:
            os.close(descriptor)


@contextmanager
def watch_folder(path: Path) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether `path` still names the same folder.

    The folder stays open meanwhile: a system gives the number of a removed folder to the next.
    """
    with _opened(open_folder(path)) as descriptor:
        found = identify(path)  # None between the two renames of another command
        yield lambda: found is not None and (descriptor is None or is_open(path, descriptor))


def sync_file(path: Path) -> None:
    """Write the content of a file to the disk."""
    with _opened(os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))) as descriptor:
        os.fsync(descriptor)


def sync_folder(path: Path) -> None:
    """Write the names in a folder to the disk, where the file system can."""
    with _opened(open_folder(path)) as descriptor:
        if descriptor is not None:
            with suppress(OSError):  # the names are in place, even if not yet on the disk
                os.fsync(descriptor)


def lock(descriptor: int) -> bool | None:
    """Lock a file or folder until it is closed; return whether it is locked, False where another
    process has the lock, None where locks are not supported.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def open_folder(path: Path) -> int | None:
    """Return a descriptor of a folder; None where the system has none."""
    try:
        return os.open(path, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0))
    except OSError:
        return None


def is_open(path: Path, descriptor: int) -> bool:
    """Return whether a path still names the file or folder that a descriptor belongs to."""
    status = os.fstat(descriptor)
    return identify(path) == (status.st_dev, status.st_ino)


NEW, OLD = "new", "old"
"""States of a leftover: written beside its target, and set aside for its successor."""

PATIENCE = 10.0  # seconds to wait until another command has written the same folder
_LEFTOVER = re.compile(r"\.loopcal-(new|old)-[0-9a-f]{16}-(.+)", re.DOTALL)
_NAME_BYTES = 200  # of the target's name in a temporary name; file systems allow 255 in all


@contextmanager
def create_temporary(target: Path, is_folder: bool = False) -> Iterator[Path]:
    """Yield a new, locked, empty file or folder beside `target`, and remove what is left of it."""
    while True:
        path = _name_beside(target, NEW)
        if is_folder:
            path.mkdir()
            descriptor = open_folder(path)
        else:
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0)
            descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0), 0o666)
        if descriptor is None and path.is_dir():
            break
        if descriptor is None:
            continue
        # another writer may find it before it is locked and take it for a leftover
        if lock(descriptor) is not False and is_open(path, descriptor):
            break
        os.close(descriptor)
    try:
        yield path
    finally:
        _remove(path)
        if descriptor is not None:
            os.close(descriptor)


def place_folder(
    temporary: Path, target: Path, path: Path, check: Callable[[Path], object]
) -> None:
    """Give a complete folder its name, and remove the folder that had it.

    `check` is called with a folder that is to be replaced, and raises where it must stay. It is
    called again with what was replaced, which another program may have changed.
    """
    for place, _, names in os.walk(temporary):
        for name in names:
            sync_file(Path(place, name))
        sync_folder(Path(place))
    note_output(path, target, temporary)
    while not _take_free_name(temporary, target):
        with _lock_folder(target) as is_locked:
            if not is_locked:  # another program has replaced or removed the old folder
                continue
            check(target)
            if not _exchange(temporary, target):
                continue
            try:
                check(temporary)
            except BaseException:  # it was changed in the last moment, and gets its name again
                _exchange(temporary, target)
                check(target)  # names the folder as the user does
                raise
            sync_folder(target.parent)
            _remove(temporary)
            return
    sync_folder(target.parent)


@contextmanager
def _lock_folder(path: Path) -> Iterator[bool]:
    """Lock a folder that is to be replaced, so that no other command replaces it meanwhile; yield
    whether it is locked, False where the name belongs to another folder now.

    OSError : another command has the lock for `PATIENCE` seconds.
    """
    with _opened(open_folder(path)) as descriptor:
        if descriptor is None:
            yield path.is_dir()  # without a lock, such as on Windows
            return
        end = time.monotonic() + PATIENCE
        while lock(descriptor) is False:
            if time.monotonic() > end:
                raise OSError(errno.EBUSY, "another command writes this folder", str(path))
            time.sleep(0.01)
        yield is_open(path, descriptor)


def _take_free_name(temporary: Path, target: Path) -> bool:
    """Rename a folder where the name is free or that of an empty folder; return whether it was."""
    if os.name == "nt" and target.is_dir() and not any(target.iterdir()):
        target.rmdir()
    try:
        temporary.rename(target)
    except OSError as error:
        # a folder that is not empty, and that another program may have set aside since
        is_taken = error.errno in (errno.ENOTEMPTY, errno.EEXIST)
        if is_taken or (error.errno == errno.EACCES and target.is_dir()):
            return False
        raise
    return True


@contextmanager
def restore_files(targets: Sequence[Path]) -> Iterator[None]:
    """Restore all files, or their absence, where the body fails; new files of others stay."""
    for target in targets:
        remove_leftovers(target, Path.is_file)
    asides = {target: _name_beside(target, OLD) for target in targets if target.exists()}
    with ExitStack() as locks, record_outputs() as list_outputs:
        try:
            for target, aside in asides.items():
                try:
                    aside.hardlink_to(target)
                except OSError:  # the file system has no second names
                    shutil.copy2(target, aside)
                locks.enter_context(_lock_leftover(aside))
            try:
                yield
            except BaseException:
                for target in list_outputs().values():
                    if target in targets and target not in asides:
                        target.unlink(missing_ok=True)
                for target, aside in asides.items():
                    aside.replace(target)
                raise
        finally:
            for aside in asides.values():
                aside.unlink(missing_ok=True)


def _exchange(new: Path, old: Path) -> bool:
    """Exchange the names of two folders; return False where another program has taken the name of
    the old one, which then stays set aside, while it had none.
    """
    aside = _name_beside(old, OLD)
    try:
        old.rename(aside)
        if not _take_free_name(new, old):
            return False
    except BaseException:
        if aside.exists() and not old.exists():
            aside.rename(old)
        raise
    aside.rename(new)
    return True


def list_leftovers(target: Path, state: str | None = None) -> list[Path]:
    """Return what killed writers left of `target` in a state (NEW, OLD, or both), oldest first."""
    name = _shorten(target.name)
    leftovers = []
    with suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            match = _LEFTOVER.fullmatch(entry.name)
            if match and match[2] == name and state in (None, match[1]):
                with suppress(OSError):  # it disappears meanwhile
                    changed = entry.stat(follow_symlinks=False).st_mtime_ns
                    leftovers.append((changed, entry.name))
    return [target.with_name(of) for _, of in sorted(leftovers)]


def remove_leftovers(target: Path, is_own: Callable[[Path], bool]) -> None:
    """Remove what killed writers left of `target` and `is_own`; rename back what was set aside."""
    for path in reversed(list_leftovers(target, OLD)):
        with _lock_leftover(path) as is_abandoned:
            if is_abandoned and path.is_dir() and not os.path.lexists(target):
                path.rename(target)
    for path in list_leftovers(target):
        with _lock_leftover(path) as is_abandoned:
            if is_abandoned and is_own(path):
                _remove(path)


@contextmanager
def _lock_leftover(path: Path) -> Iterator[bool]:
    """Yield whether a leftover has no living writer; it is locked, so that no other takes it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except (OSError, AttributeError):
        yield False
        return
    with _opened(descriptor):
        yield lock(descriptor) is True and is_open(path, descriptor)


def _remove(path: Path) -> None:
    """Remove a file or a folder, but nothing that a link names."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _name_beside(target: Path, state: str) -> Path:
    """Return an unpredictable name in the folder of `target`."""
    name = _shorten(target.name)
    return target.with_name(f".loopcal-{state}-{secrets.token_hex(8)}-{name}")


def _shorten(name: str) -> str:
    """Return the end of a file name, which includes its suffix."""
    return os.fsdecode(os.fsencode(name)[-_NAME_BYTES:])


# Text and JSON files.

# To open a file without waiting; not every system has all of these flags.
OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
# What to do about a file that the operating system does not open, by the number of its error.
ACTIONS = {
    errno.EACCES: "check its permissions",
    errno.EPERM: "check its permissions",
    errno.ELOOP: "this path contains a symbolic link that leads back to itself: make it anew, or "
    "name the file itself",
    errno.ENOTDIR: "part of its path is a file, not a folder: correct the path",
}


def as_path(path: Any, what: str) -> Path:
    """Return a path given as text or Path; DataError where no file can have this name, or where
    another object stands in its place.
    """
    try:
        name = os.fsencode(path)
    except TypeError:
        given = type(path).__name__
        sentence = f"the path of the {what} is of type {given}. Give a text or a pathlib.Path"
        raise DataError(f"{sentence} (the order of savers is save_..(object, path))") from None
    except UnicodeEncodeError:
        name = b"\0"
    if b"\0" in name:
        sentence = f"the path of the {what} contains a null character or half of a character"
        raise DataError(f"{sentence}, which no file name can have. Correct the path")
    return Path(path)


def read_text(path: str | Path, what: str, hint: str = "", limit: FileLimit = PROGRAM_SIZE) -> str:
    """Return the text of a UTF-8 file without a byte order mark. Lines that end as on an old Mac,
    all by CR, end by LF.

    `what` it should be, such as "robot file", and a `hint` beside saving it as UTF-8 are for
    messages. FileError : see `read_bytes`; or the file is not UTF-8, or is empty.
    """
    raw = read_bytes(path, what, limit)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        byte = f"byte 0x{raw[error.start]:02x}"
        sentence = f"this {what} is not UTF-8 text ({byte}). Save it as UTF-8{hint}"
        raise FileError(sentence, path, line) from None
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        sentence = f"this {what} contains a zero byte and is not UTF-8 text. Save it as UTF-8{hint}"
        raise FileError(sentence, path, line)
    if not text.strip():
        raise FileError(f"this {what} is empty. See the examples that come with loopcal", path)
    return text if "\n" in text else text.replace("\r", "\n")


def read_bytes(path: str | Path, what: str, limit: FileLimit = PROGRAM_SIZE) -> bytes:
    """Return the content of an ordinary file; `what` it should be is for messages.

    FileError : the file does not exist, is a folder, device or pipe, not readable, or too large.
    """
    with open_bytes(path, what) as stream:
        size = os.fstat(stream.fileno()).st_size
        limit.check(size, what, path)
        raw = b""
        while len(raw) <= limit.count:  # the file may grow, or the system states no size
            part = stream.read(min(max(size, len(raw), 1 << 16), limit.count) + 1)
            if part is None:  # reading would wait for more, as in /proc/kmsg
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            if not part:
                break
            raw += part
    if len(raw) > limit.count:
        raise limit.make_error(what, path)
    return raw


@contextmanager
def open_bytes(path: str | Path, what: str) -> Iterator[BufferedReader]:
    """Open an ordinary file to read it; raise FileError as `read_bytes` but for the size."""
    path = as_path(path, what)
    try:
        if path.is_dir():  # not every system opens a folder
            raise FileError(f"this is a folder. Name the {what} in it", path)
        # opening does not wait, as it would for a pipe, and what was opened is examined rather than
        # the name, which may denote another file a moment later
        with os.fdopen(os.open(path, OPEN_FLAGS), "rb") as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                sentence = f"this is a device or a pipe. Save the {what} as an ordinary file"
                raise FileError(f"{sentence} and name that", path)
            yield stream
    except FileNotFoundError:
        raise FileError(
            f"this {what} does not exist. Check the name and the folder", path
        ) from None
    except OSError as error:
        action = ACTIONS.get(error.errno or 0, "check the file, its path and its permissions")
        raise FileError(f"cannot read this {what} ({_reason(error)}); {action}", path) from error


def sha256(path: str | Path) -> str:
    """Return the SHA-256 digest of a file as hexadecimal text; raise FileError as `open_bytes`."""
    with open_bytes(path, "file") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def resolve_target(path: str | Path) -> Path:
    """Return the file that a write to `path` changes: `path`, or the target of a symbolic link.

    FileError : the path is a folder, a device or a pipe, or a link without a target.
    """
    path = as_path(path, "file to write")
    if path.is_dir():
        raise FileError("this is a folder. Add the name of the file to write", path)
    if path.exists() and not path.is_file():
        raise FileError("this is a device or a pipe. Name an ordinary file", path)
    return resolve_links(path) if path.is_symlink() else path


def resolve_links(path: Path) -> Path:
    """Return a path without links and dots; FileError for a circular link, or a name too long."""
    with report_write_errors(path), suppress(RuntimeError):
        found = path.resolve()
        if not found.is_symlink():  # Python 3.13 returns a circular link
            return found
    raise FileError("this symbolic link has no target. Choose another name", path)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 file whole or not at all; see `write_bytes`."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all; see `replace_file`."""
    with replace_file(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def replace_file(path: str | Path) -> Iterator[Path]:
    """Yield an empty temporary file that takes the place of `path` where the body succeeds.

    A symbolic link stays a link; its target is written. An old file keeps its permissions.
    FileError : see `resolve_target`; the folder does not exist, no permission, or a full disk.
    """
    target = resolve_target(path)
    with report_write_errors(path):
        remove_leftovers(target, Path.is_file)
        with create_temporary(target) as temporary:
            yield temporary
            sync_file(temporary)
            if target.exists():
                temporary.chmod(stat.S_IMODE(target.stat().st_mode))
            is_new = was_free(target)
            note_output(Path(path), target, temporary)
            if is_new:
                _take_new_name(temporary, target, path)
            temporary.replace(target)  # does nothing where both name one file
            sync_folder(target.parent)


def _take_new_name(temporary: Path, target: Path, path: str | Path) -> None:
    """Give a file the name that was free before; FileError where another command has taken it."""
    try:
        try:
            target.hardlink_to(temporary)
        except FileExistsError:
            raise
        except OSError:  # the file system has no second names
            os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        raise FileError.of("files.output-exists", path) from None


@contextmanager
def name_files(*paths: str | Path) -> Iterator[None]:
    """Put files in front of the text of an error of the body that does not name its file, except
    that of a missing package or engine, for which no file is the reason.
    """
    try:
        yield
    except (FileError, MissingPackageError):
        raise
    except LoopcalError as error:
        raise type(error)(f"{' and '.join(map(str, paths))}: {error}") from error


@contextmanager
def report_write_errors(path: str | Path) -> Iterator[None]:
    """Raise FileError in place of every OSError of the body, which writes `path`."""
    try:
        yield
    except OSError as error:
        folder = Path(path).parent
        if isinstance(error, FileNotFoundError) and not folder.is_dir():
            sentence = f"folder {folder} does not exist. Create it first"
            raise FileError(sentence, path) from None
        raise FileError(
            f"cannot write here ({_reason(error)}). Choose another place", path
        ) from error


def _reason(error: OSError) -> str:
    """Return the reason that the operating system states, in lower case."""
    return (error.strerror or type(error).__name__).lower()


# JSON text without NaN.

PIECES = 10_000  # pieces of JSON text, such as a number, that are put together at once
LONGEST_WHOLE = 308  # digits of a whole number that always fits a double


def to_json(document: Mapping[str, Any]) -> str:
    """Return a document (dataclasses, arrays, enums, paths, numbers, text, lists, mappings) as
    JSON text that ends with a line break.

    A number that is not finite becomes null. The key `nulls` then maps its place, such as
    `parameters/3/plus_minus`, to the reason.
    """
    return "".join(iterate_content(convert_document(document)))


def convert_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the JSON text of a document, see `to_json`."""
    nulls: dict[str, str] = {}
    content = serialization.to_json(document, nulls)
    return {**content, "nulls": nulls} if nulls else content


def iterate_content(content: Mapping[str, Any]) -> Iterator[str]:
    """Yield the JSON text of what `convert_document` returns, part by part."""
    pieces = json.JSONEncoder(indent=2, allow_nan=False, ensure_ascii=False).iterencode(content)
    while part := "".join(islice(pieces, PIECES)):
        yield escape_json(part)
    yield "\n"


def read_json(path: str | Path, what: str, action: str, limit: FileLimit = PROGRAM_SIZE) -> Any:
    """Return the content of a JSON file; `what` it should be and `action` are for messages.

    FileError : see `read_text`; or not JSON, a number that is not finite, a key that is there
    twice, or nested too deeply.
    """
    text = read_text(path, what, limit=limit)
    JSON_VALUES.check(sum(text.count(sign) for sign in ",:[{"), what, path)
    try:
        content = json.loads(
            text,
            parse_float=_parse_finite,
            parse_int=lambda text: (int if len(text) <= LONGEST_WHOLE else _parse_finite)(text),
            parse_constant=_parse_finite,
            object_pairs_hook=_refuse_duplicates,
        )
    except json.JSONDecodeError as error:
        sentence = f"not valid JSON ({error.msg}); {action}"
        raise FileError(sentence, path, error.lineno) from None
    except ValueError as error:
        raise FileError(f"not valid JSON ({error}); {action}", path) from None
    except RecursionError:
        raise JSON_DEPTH.make_error(what, path) from None
    depth, layer = 0, [content]
    while layer := [node for node in layer if isinstance(node, list | dict)]:
        depth += 1
        layer = [c for n in layer for c in (n.values() if isinstance(n, dict) else n)]
    JSON_DEPTH.check(depth, what, path)
    return content


def _parse_finite(text: str) -> float:
    """Return the double of a number in a JSON text; ValueError where it is not finite."""
    if math.isfinite(value := float(text)):
        return value
    if len(text) > 20:
        raise ValueError(f"the number {text[:20]}… is too large")
    raise ValueError(f"the number {text} is not finite")


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the mapping of a JSON object whose keys are different."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"the key {key!r} is there twice")
        content[key] = value
    return content
