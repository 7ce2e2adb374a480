# SPDX-License-Identifier: Apache-2.0
"""The arrays of a run folder: an archive of NumPy's, read without trust in what it says of itself.

A small archive can state a huge array, and a compressed one can contain it. Therefore members are
never compressed (loopcal writes none that are), and memory is taken only for an array whose bytes
are in the file.
"""

from __future__ import annotations

import math
import os
import struct
import tokenize
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from loopcal.io.core.limits import ARRAYS_COUNT, ARRAYS_SIZE, FileLimit
from loopcal.io.core.text_file import open_bytes

WHAT = "archive of arrays"
KINDS = "biufU"
"""Kinds of NumPy's types that a run contains: truth values, numbers and text."""

FAULTS = (
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    SyntaxError,
    tokenize.TokenError,
)
"""What Python's and NumPy's readers raise about damaged archives, in addition to ValueError."""

END = struct.Struct("<4s4H2LH")
"""The last record of an archive: among others its signature, count of members and bytes of their
directory.
"""


def read_arrays(
    path: Path, size: FileLimit = ARRAYS_SIZE, count: FileLimit = ARRAYS_COUNT
) -> dict[str, np.ndarray]:
    """Return name -> array, read-only, of a file that `numpy.savez` wrote.

    Parameters
    ----------
    path : the file. size : limit of its bytes, and of all arrays. count : limit of its arrays.

    Raises
    ------
    FileError : not an ordinary file, not readable, or beyond a limit.
    ValueError : damaged; the text says how.
    """
    with open_bytes(path, WHAT) as stream:
        size.check(os.fstat(stream.fileno()).st_size, WHAT, path)
        count.check(_count_members(stream), WHAT, path)
        try:
            with zipfile.ZipFile(stream) as archive:
                members = archive.infolist()
                count.check(len(members), WHAT, path)
                size.check(sum(member.file_size for member in members), WHAT, path)
                return {
                    member.filename.removesuffix(".npy"): _read_member(archive, member)
                    for member in members
                }
        except FAULTS as error:
            raise ValueError(str(error) or "it ends too early") from error


def _count_members(stream: BinaryIO) -> int:
    """Return the number of members that the end of an archive states."""
    length = stream.seek(0, os.SEEK_END)
    if length < END.size:
        raise ValueError("it is too short")
    stream.seek(length - END.size)
    signature, *counts = END.unpack(stream.read(END.size))
    if signature != b"PK\5\6":
        raise ValueError("it is no archive, or its end is missing")
    stream.seek(0)
    return int(counts[3])


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Return one array; ValueError where its header does not agree with its bytes."""
    name = member.filename
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f"{name!r} is compressed")
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"{name!r} has another version than 1.0")
        shape, is_fortran, kind = np.lib.format.read_array_header_1_0(stream)
        if kind.kind not in KINDS or kind.itemsize == 0:
            raise ValueError(f"{name!r} contains neither numbers nor text")
        if math.prod(shape) * kind.itemsize != member.file_size - stream.tell():
            raise ValueError(f"{name!r} has another size than its header states")
        values = np.frombuffer(stream.read(), kind)
    return values.reshape(shape, order="F" if is_fortran else "C")
