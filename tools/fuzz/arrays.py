# SPDX-License-Identifier: Apache-2.0
"""Damage to the arrays of an .npz file."""

from __future__ import annotations

import io
import zipfile
from random import Random
from typing import Any

import numpy as np

from tools.fuzz.values import draw_number

TYPES: tuple[Any, ...] = (np.float32, np.int64, np.complex128, np.bool_, "U8", object)


def mutate_arrays(content: bytes, rng: Random) -> tuple[bytes, str]:
    """Return a damaged copy of an .npz file, and the name of the damage."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    if rng.random() < 0.1:
        return _write_zip(rng), "zip"
    name = rng.choice(list(arrays))
    kind = rng.choice(["delete", "shape", "type", "number", "rename", "swap", "scale"])
    array = arrays[name]
    if kind == "delete":
        del arrays[name]
    elif kind == "shape":
        arrays[name] = _reshape(array, rng)
    elif kind == "type":
        arrays[name] = _retype(array, rng.choice(TYPES))
    elif kind == "number":
        arrays[name] = _set_number(array, rng)
    elif kind == "rename":
        arrays[rng.choice(["x", "", name + "2", "../x"])] = arrays.pop(name)
    elif kind == "swap":
        arrays[name] = arrays[rng.choice(list(arrays))]
    elif np.issubdtype(array.dtype, np.number):
        with np.errstate(all="ignore"):
            arrays[name] = array * rng.choice([-1, 0, 1e3, 1e200, float("nan")])
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue(), f"array-{kind}"


def _retype(array: np.ndarray, kind: Any) -> np.ndarray:
    """Return an array of another type; where its values do not become numbers, zeros."""
    is_text = array.dtype.kind in "US"
    with np.errstate(invalid="ignore"):  # what is no number becomes any integer
        return np.zeros(array.shape, kind) if is_text and kind is not object else array.astype(kind)


def _reshape(array: np.ndarray, rng: Random) -> np.ndarray:
    return rng.choice(
        [
            array[None],
            array.reshape(-1),
            array[:0],
            np.zeros(()),
            np.concatenate([array.reshape(-1)] * 2),
            array.T,
        ]
    )


def _set_number(array: np.ndarray, rng: Random) -> np.ndarray:
    if not np.issubdtype(array.dtype, np.floating) or not array.size:
        return np.zeros(3)
    changed = array.copy()
    changed.flat[rng.randrange(array.size)] = float(draw_number(rng))
    return changed


def _write_zip(rng: Random) -> bytes:
    """Return a zip file that is no file of arrays, or one that grows when it is read."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        match rng.randrange(4):
            case 0:
                archive.writestr("a.txt", "text")
            case 1:
                archive.writestr("estimate.npy", b"\x93NUMPY\x01\x00")
            case 2:
                archive.writestr("estimate.npy", bytes(20_000_000))
            case _:
                pass
    return file.getvalue()
