# SPDX-License-Identifier: Apache-2.0
"""All trials of a study as one table for other programs: CSV or Parquet, written cell by cell."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from loopcal.environment import import_optional
from loopcal.errors import DataError, StudyError
from loopcal.io.core.text_file import replace_file
from loopcal.studies.files.store import StudyStore
from loopcal.studies.results.study_result import iterate_trials
from loopcal.studies.specification.study import Study
from loopcal.typing import FloatArray, Progress, report_no_progress


def export_trials(
    study: Study, store: StudyStore, path: Path, progress: Progress = report_no_progress
) -> int:
    """Write all stored trials as one table, and return their number.

    Columns are all factors, the trial, and the scores in SI. A CSV file has their units in its
    header; a Parquet file has them in the metadata of its columns.

    Parameters
    ----------
    path : its ending decides the format. It is written whole or not at all.

    Raises DataError: another ending. FileError: it cannot be written. StudyError: pyarrow is
    missing.
    """
    ending = path.suffix.lower()
    if ending not in (".csv", ".parquet"):
        raise DataError(f"{path} must end in .csv or .parquet, which decides its format")
    write = _write_csv if ending == ".csv" else _write_parquet
    with replace_file(path) as temporary, store.keep_state():
        return write(study, store, temporary, progress)


def _write_csv(study: Study, store: StudyStore, path: Path, progress: Progress) -> int:
    names, count = tuple(study.levels), 0
    units = [f" [{c.unit}]" if c.unit != "1" else "" for c in study.columns]
    titles = [f"{c.name}{unit}" for c, unit in zip(study.columns, units, strict=True)]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*names, "trial", *titles])
        for cell in study.cells:
            progress(cell.number, len(study.cells), "writing trials")
            levels = [cell.levels[name] for name in names]
            for first, scores in iterate_trials(study, store, cell):
                for i, row in enumerate(scores.tolist()):
                    numbers = [value if math.isfinite(value) else "" for value in row]
                    writer.writerow([*levels, first + i, *numbers])
                count += len(scores)
    return count


def _write_parquet(study: Study, store: StudyStore, path: Path, progress: Progress) -> int:
    arrow = import_optional("pyarrow", "tables", StudyError)
    parquet = import_optional("pyarrow.parquet", "tables", StudyError)
    names, count = tuple(study.levels), 0
    word = arrow.dictionary(arrow.int32(), arrow.string())
    schema = arrow.schema(
        [
            *(arrow.field(name, word) for name in names),
            arrow.field("trial", arrow.int64()),
            *(
                arrow.field(c.name, arrow.float64(), metadata={"unit": c.unit})
                for c in study.columns
            ),
        ]
    )
    with parquet.ParquetWriter(path, schema) as writer:
        for cell in study.cells:
            progress(cell.number, len(study.cells), "writing trials")
            tables = [
                _make_table(arrow, schema, [cell.levels[name] for name in names], first, scores)
                for first, scores in iterate_trials(study, store, cell)
            ]
            if tables:
                table = arrow.concat_tables(tables).combine_chunks()
                writer.write_table(table)
                count += table.num_rows
    return count


def _make_table(arrow: Any, schema: Any, levels: list[str], first: int, scores: FloatArray) -> Any:
    """Return the table of one block."""
    rows = len(scores)
    words = [
        arrow.DictionaryArray.from_arrays(arrow.array([0] * rows, arrow.int32()), [level])
        for level in levels
    ]
    numbers = [arrow.array(range(first, first + rows), arrow.int64())]
    columns = [arrow.array(column) for column in scores.T.copy()]
    return arrow.table([*words, *numbers, *columns], schema=schema)
