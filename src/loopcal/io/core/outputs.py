# SPDX-License-Identifier: Apache-2.0
"""Output files, all checked before the first one is written, and result folders.

Files and folders are written whole or not at all, and never over something else: a folder only
over one that loopcal made. One document of each folder, such as result.json, lists under `files`
all others and itself with their sha256. With `force`, a folder of the same kind is replaced if it
contains these files and no others, all unchanged.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

from loopcal.errors import FileError
from loopcal.io.core import text_file
from loopcal.io.core.limits import TABLE_SIZE
from loopcal.output_record import note_output

FILES = "files"  # key of the list of files in the document of a result folder


def refuse_outputs(
    outputs: Sequence[Path | None], inputs: Sequence[Path | None], force: bool
) -> None:
    """Refuse outputs that cannot or should not be written; None is skipped.

    FileError : an output is an input (or in a folder of inputs) or another output, exists (without
    `force`), is a folder, a device or the document of a result folder, or its folder does not
    exist or is not writable. A symbolic link stands for its target.
    """
    read = [
        file
        for path in inputs
        if path is not None
        for file in (path.iterdir() if path.is_dir() else (path,))
        if file.exists()
    ]
    wanted = [path for path in outputs if path is not None]
    for i, path in enumerate(wanted):
        folder = text_file.resolve_target(path).parent
        if any(_is_same_file(path, other) for other in read):
            raise FileError(
                "this output is also an input of this command. Choose another name", path
            )
        if any(_is_same_file(path, other) for other in wanted[:i]):
            raise FileError("two outputs have this name. Choose another name for one of them", path)
        if not folder.is_dir():
            raise FileError(f"folder {folder} does not exist. Create it first", path)
        if not os.access(folder, os.W_OK):
            raise FileError("cannot write here (permission denied). Choose another folder", path)
        if path.is_file() and not force:
            raise FileError.of("files.output-exists", path)
        if not force:  # another command may take the name before this one has its result
            note_output(path, text_file.resolve_target(path), None)
        document = _read_document(path) if path.suffix == ".json" and path.is_file() else None
        if isinstance((document or {}).get(FILES), dict):  # that of a result folder
            raise FileError.of("files.output-in-result", path)


@contextmanager
def restore_on_failure(outputs: Sequence[Path | None]) -> Iterator[None]:
    """Restore or remove these files where the body fails; None is skipped."""
    with text_file.restore_files(
        [text_file.resolve_target(path) for path in outputs if path is not None]
    ):
        yield


def write_files(files: Mapping[Path, str] | Mapping[Path, str | bytes]) -> None:
    """Write files (path -> content) whole, or none of them; FileError where that is impossible."""
    with restore_on_failure(tuple(files)):
        for path, content in files.items():
            text_file.write_bytes(
                path, content.encode("utf-8") if isinstance(content, str) else content
            )


def _is_same_file(path: Path, other: Path) -> bool:
    """Return whether two names denote one file, existing or not."""
    if path.exists() and other.exists():
        return path.samefile(other)
    # not Path.resolve, which refuses a link that leads to itself
    return os.path.realpath(path) == os.path.realpath(other)


@contextmanager
def replace_folder(
    path: Path, check: Callable[[Path], object] = lambda _: None, names: Collection[str] = ()
) -> Iterator[Path]:
    """Yield a temporary folder that takes the place of `path` where the body succeeds.

    At every moment, `path` is the old or the new folder, complete. A symbolic link to a folder
    stays a link. `check` raises FileError where a folder must not be replaced, as every OSError
    does. Folders of killed commands beside it, with no other files than `names`, are removed.
    """

    def is_left_of_us(left: Path) -> bool:
        return left.is_dir() and all(file.name in names for file in left.iterdir())

    with text_file.report_write_errors(path):
        target = text_file.resolve_links(path)
        if names:
            text_file.remove_leftovers(target, is_left_of_us)
        target.parent.mkdir(parents=True, exist_ok=True)
        with text_file.create_temporary(target, is_folder=True) as temporary:
            yield temporary
            text_file.place_folder(temporary, target, path, check)


_BLANK = "0" * 64  # stands for the document's own digest where this is computed


class FolderKind(NamedTuple):
    """What a command writes as a folder: `content`, such as "run", for messages.

    It is recognized by the file `document`, which lists the others, and the `keys` in it. `names`
    are patterns of the other files, such as `tables/*.csv`.
    """

    content: str
    document: str
    keys: tuple[str, ...]
    names: tuple[str, ...]


def refuse_folder(path: Path, kind: FolderKind, force: bool, inputs: Sequence[Path] = ()) -> None:
    """Refuse a folder that cannot or must not be written; a folder set aside gets its name again.

    FileError : the path is a file, or the working folder; its place is not writable; the folder is
    in use (without `force`), or protected; or it contains an input of the command, or anything but
    an unchanged result of this kind.
    """
    target = text_file.resolve_links(path)
    with text_file.report_write_errors(path):
        # what killed commands left beside a folder; one that was set aside is renamed back
        text_file.remove_leftovers(target, lambda folder: _is_own(folder, kind))
        if target.exists() and not target.is_dir():
            sentence = f"this is a file, but the {kind.content} is a folder. Choose another name"
            raise FileError(sentence, path)
        is_mount = target.is_mount()
        if is_mount or Path.cwd().is_relative_to(target):
            example = str(path / "result")
            raise FileError.of("files.folder-in-place", path, is_mount=is_mount, example=example)
        parent = next(folder for folder in target.parents if folder.exists())
        if not parent.is_dir():
            sentence = f"cannot write here: {parent} is not a folder. Choose another place"
            raise FileError(sentence, path)
        if not os.access(parent, os.W_OK | os.X_OK):
            raise FileError("cannot write here (permission denied). Choose another folder", path)
        for file in inputs:
            if file.exists() and file.resolve().is_relative_to(target):
                sentence = f"replacing this folder would remove the input {file}"
                raise FileError(f"{sentence}. Choose another name", path)
        if target.is_dir() and any(target.iterdir()):
            if not force:
                raise FileError.of("files.folder-in-use", path, content=kind.content)
            _refuse_other_content(path, kind)
            places = (place for place, _, _ in os.walk(target))  # gone where another command writes
            if any(os.path.lexists(p) and not os.access(p, os.W_OK | os.X_OK) for p in places):
                sentence = "this folder permits no changes"
                raise FileError(f"{sentence}. Choose another name, or permit writing in it", path)


def _refuse_other_content(path: Path, kind: FolderKind) -> None:
    """Raise FileError where a folder is not an unchanged result of this kind, and nothing else."""
    while path.is_dir():
        with text_file.watch_folder(path.resolve()) as is_same:
            try:
                document = _read_document(path / kind.document) or {}
                listed = _list_digests(document)
                if not listed or any(key not in document for key in kind.keys):
                    raise FileError.of("files.folder-of-others", path, content=kind.content)
                names = list(_list_entries(path))
                foreign = [name for name in names if not _is_expected(path, name, kind, listed)]
                code, wrong = "files.foreign-files", foreign
                if not foreign:
                    code = "files.changed-files"
                    wrong = [name for name in names if _is_changed(path, name, kind, listed)]
                if wrong:
                    raise FileError.of(code, path, content=kind.content, files=tuple(wrong))
                return
            except (FileError, OSError):
                if is_same():
                    raise  # otherwise another command has replaced the folder meanwhile


def list_changed_files(path: Path, kind: FolderKind) -> tuple[str, ...]:
    """Return the files of a folder that differ from what was written; without a list of files the
    document itself, because nothing is known of it.
    """
    listed = _list_digests(_read_document(path / kind.document) or {})
    if kind.document not in listed:
        return (kind.document,)
    present = (name for name in listed if (path / name).is_file())
    return tuple(name for name in present if _is_changed(path, name, kind, listed))


def write_result_folder(
    path: Path,
    kind: FolderKind,
    document: Mapping[str, Any],
    files: Mapping[str, bytes | Callable[[Path], object]],
    force: bool = False,
) -> None:
    """Write a folder whole or not at all: `files` by name, as bytes or as a function that writes
    them, and the document with their digests; FileError as `refuse_folder`, or where the folder
    cannot be written.
    """
    digests = dict.fromkeys((*sorted(files), kind.document), _BLANK)
    computed = text_file.convert_document({**document, FILES: digests})

    refuse_folder(path, kind, force)
    with replace_folder(path, lambda old: refuse_folder(old, kind, force)) as folder:
        for name, content in files.items():
            file = folder / name
            file.parent.mkdir(exist_ok=True)
            if isinstance(content, bytes):
                file.write_bytes(content)
            else:
                content(file)
        written = digests | {name: text_file.sha256(folder / name) for name in files}
        digest = hashlib.sha256()
        for part in text_file.iterate_content({**computed, FILES: written}):
            digest.update(part.encode())
        written[kind.document] = digest.hexdigest()
        with (folder / kind.document).open("wb") as stream:
            stream.writelines(
                map(str.encode, text_file.iterate_content({**computed, FILES: written}))
            )


def describe_leftover(path: Path, document: str) -> str:
    """Return a sentence on a folder that a killed command set aside; empty where there is none."""
    for folder in text_file.list_leftovers(text_file.resolve_links(path)):
        if (folder / document).is_file():
            return f"an interrupted command left it as {folder}. Rename this folder"
    return ""


def _is_own(folder: Path, kind: FolderKind) -> bool:
    """Return whether a leftover only contains what loopcal wrote: a part of a result, or all."""
    listed = _list_digests(_read_document(folder / kind.document) or {})
    try:
        return folder.is_dir() and not any(
            not _is_expected(folder, name, kind, listed)
            or (bool(listed) and _is_changed(folder, name, kind, listed))
            for name in _list_entries(folder)
        )
    except (OSError, FileError):  # it disappears meanwhile
        return False


def _is_expected(path: Path, name: str, kind: FolderKind, listed: Mapping[str, str]) -> bool:
    """Return whether an entry belongs to the folder: a file, or an empty folder for files."""
    entry = path / name
    if entry.is_symlink():
        return False
    if entry.is_dir():
        return any(pattern.startswith(f"{name}/") for pattern in kind.names)
    is_listed = not listed or name in listed
    is_known = name == kind.document or any(
        name.count("/") == pattern.count("/") and fnmatchcase(name, pattern)
        for pattern in kind.names
    )
    return is_known and is_listed and entry.is_file()


def _is_changed(path: Path, name: str, kind: FolderKind, listed: Mapping[str, str]) -> bool:
    """Return whether a listed file differs from what was written."""
    if (path / name).is_dir():
        return False
    if name != kind.document:
        return text_file.sha256(path / name) != listed[name]
    digest = _quote(kind, listed[name]).encode()
    content = (path / name).read_bytes().replace(digest, _quote(kind, _BLANK).encode())
    return hashlib.sha256(content).hexdigest() != listed[name]


def _quote(kind: FolderKind, digest: str) -> str:
    """Return the document's own entry in the list of files."""
    return f'"{kind.document}": "{digest}"'


def _list_entries(path: Path, prefix: str = "") -> Iterator[str]:
    """Yield the names of all files, links and empty folders, in order."""
    for entry in sorted(path.iterdir()):
        if entry.is_dir() and not entry.is_symlink() and any(entry.iterdir()):
            yield from _list_entries(entry, f"{prefix}{entry.name}/")
        else:
            yield f"{prefix}{entry.name}"


def _read_document(path: Path) -> dict[str, Any] | None:
    """Return the document of a folder; None where it is missing or damaged."""
    try:
        content = text_file.read_json(path, "result", "repeat the command", TABLE_SIZE)
    except FileError:
        return None
    return content if isinstance(content, dict) else None


def _list_digests(document: Mapping[str, Any]) -> dict[str, str]:
    """Return name -> sha256 of a document's files; nothing where it does not list them."""
    files = document.get(FILES)
    if not isinstance(files, dict):
        return {}
    return {str(name): str(digest) for name, digest in files.items()}
