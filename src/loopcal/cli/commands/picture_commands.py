# SPDX-License-Identifier: Apache-2.0
"""A printed board, and pictures of it."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import options as opt
from loopcal.cli.terminal import Output


@opt.command()
def board(
    columns: int = opt.option("Columns of squares.", type=opt.Count("SQUARES", 3), default=10),
    rows: int = opt.option("Rows of squares.", type=opt.Count("SQUARES", 3), default=7),
    square: float = opt.option("Side of a square.", type=opt.POSITIVE_LENGTH, default="25mm"),
    paper: str = opt.option(
        "Sheet of paper.", type=click.Choice(("a4", "a3", "letter")), default="a4"
    ),
    output: Path = opt.path(
        "File that describes the board, such as board.yaml. The drawings get its name with .svg "
        "and .pdf.",
        "-o",
        required=True,
    ),
    force: bool = opt.force("the output files"),
) -> Output:
    """Draw a board to print: squares with markers (ChArUco), for pictures by a phone or camera.

    Print it at 100 %, without fit to page, glue it to a flat plate, and measure the two lengths
    next to the squares. Enter them in the file. The command needs the extra 'camera'.

    Examples:
      loopcal board -o board.yaml
      loopcal board -o board.yaml --columns 12 --rows 8 --square 15mm --paper letter
    """
    from loopcal.errors import DataError
    from loopcal.io.board import (
        PAPERS,
        choose_board,
        draw_board,
        format_board,
        format_pdf,
        format_svg,
    )
    from loopcal.io.core.outputs import refuse_outputs, restore_on_failure
    from loopcal.io.core.text_file import write_bytes, write_text

    if output.suffix not in (".yaml", ".yml"):
        raise DataError(f"{output} describes the board. Use a name that ends in .yaml")
    files = output, output.with_suffix(".svg"), output.with_suffix(".pdf")
    refuse_outputs(files, (), force)
    chosen, sheet = choose_board(columns, rows, square), PAPERS[paper]
    shapes, words = draw_board(chosen, sheet)
    with restore_on_failure(files):
        write_text(files[0], format_board(chosen))
        write_text(files[1], format_svg(shapes, words, sheet))
        write_bytes(files[2], format_pdf(shapes, words, sheet))
    document = {
        "board": files[0],
        "drawings": files[1:],
        "squares": chosen.squares,
        "square": chosen.square,
        "dictionary": chosen.dictionary,
        "lengths": chosen.marks,
    }
    x, y = (1e3 * length for length in chosen.marks)
    page = [
        f"{files[0]}: {columns} x {rows} squares, drawn in {files[1]} and {files[2]}",
        "Print at 100 %, without fit to page, and glue the print to a flat plate",
        f"Measure {x:g} mm along x and {y:g} mm along y. Enter both as 'measured' in {files[0]}",
    ]
    return Output(document, lambda: page)
