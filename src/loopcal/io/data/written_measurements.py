# SPDX-License-Identifier: Apache-2.0
"""Check of a written measurement file: it is read, and compared with what was written."""

from __future__ import annotations

import unicodedata
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from loopcal.io.core.csv_table import read_template, require_columns
from loopcal.io.core.read_back import require_same, require_same_numbers
from loopcal.io.data.kind_rows import read_kinds
from loopcal.io.data.measurement_file import build_instrument, load_measurements
from loopcal.mechanism import Mechanism
from loopcal.typing import IntArray

if TYPE_CHECKING:
    from loopcal.measure import Instrument, Measurements, Observations

ROUNDING = 1e-7
"""Change of a covariance, in those of its rows, and of a standard deviation: a file states the
latter with nine digits."""


def check_written_measurements(path: Path, data: Measurements, robot: Mechanism) -> None:
    """Read a measurement file; raise LoopcalError where it does not hold these measurements.

    Poses may come in another order, names in Unicode normal form C. Rows of weight 0 and weights
    are not written.
    """
    read = load_measurements(path, robot, allow_outside_stroke=True, allow_duplicates=True)
    labels = [unicodedata.normalize("NFC", label) for label in data.labels]
    require_same("names of poses", sorted(labels), sorted(read.labels))
    place = {label: i for i, label in enumerate(read.labels)}
    order = np.array([place[label] for label in labels], dtype=int)
    require_same_numbers("readings", data.readings, read.readings[order])
    require_same("use of poses", data.is_held_out.tolist(), read.is_held_out[order].tolist())
    blocks = dict(zip(data.block.tolist(), read.block[order].tolist(), strict=True))
    require_same("blocks", [blocks[b] for b in data.block.tolist()], read.block[order].tolist())
    require_same("blocks", len(blocks), len(set(read.block.tolist())))
    written = [rows for rows in data.all_observations if rows.weight.any()]
    kinds = [rows.kind.name for rows in read.all_observations]
    require_same("kinds", [rows.kind.name for rows in written], kinds)
    for before, after in zip(written, read.all_observations, strict=True):
        _check_rows(before, after, order)


def check_written_template(path: Path, text: str, robot: Mechanism, instrument: Instrument) -> None:
    """Read a measurement file without rows; raise LoopcalError where it is not this text, its
    columns have no meaning or are not complete, or it states another instrument.
    """
    require_same("text", text, path.read_text("utf-8"))
    table = read_template(path)
    columns = dict.fromkeys(table.names, ("",))
    empty = replace(table, columns=columns, lines=(table.header_line + 1,))
    read = build_instrument(empty, read_kinds(empty, robot)).sensors
    require_same("kinds", [s.kind.name for s in instrument.sensors], [s.kind.name for s in read])
    for before, after in zip(instrument.sensors, read, strict=True):
        name = f"noise of {before.kind.name}"
        require_same_numbers(name, before.noise.sigma, after.noise.sigma, ROUNDING)
    require_columns(table, [actuator.name for actuator in robot.actuators], "a reading")


def _check_rows(before: Observations, after: Observations, order: IntArray) -> None:
    """Compare the rows of one kind that have a measured value.

    Parameters
    ----------
    order : place in the file of each pose.
    """
    kept, name = (before.weight > 0) & before.is_measured, before.kind.name
    after = after.take(after.is_measured)
    if not before.kind.is_of_base:
        require_same(f"poses of {name}", order[before.rows[kept]].tolist(), after.rows.tolist())
    require_same_numbers(f"measured values of {name}", before.measured[kept], after.measured)
    sd = np.where(before.present, np.sqrt(np.diagonal(before.covariance, 0, 1, 2)), np.inf)[kept]
    change = (after.covariance - before.covariance[kept]) / (sd[:, :, None] * sd[:, None, :])
    require_same(f"covariances of {name}", True, bool((np.abs(change) <= ROUNDING).all()))
    require_same(f"instrument of {name}", before.instrument, after.instrument)
    for what in ("session", "group"):
        values = [unicodedata.normalize("NFC", v) for v in getattr(before, what)[kept].tolist()]
        require_same(f"{what}s of {name}", values, getattr(after, what).tolist())
    for what, values in before.context.items():
        require_same_numbers(f"{what} of {name}", values[kept], after.context[what])
