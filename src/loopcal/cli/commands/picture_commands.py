# SPDX-License-Identifier: Apache-2.0
"""A printed board, and pictures of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import suggest_command
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
    from loopcal.io.core.outputs import refuse_outputs, restore_on_failure
    from loopcal.io.core.text_file import write_bytes, write_text
    from loopcal.io.pictures import (
        PAPERS,
        choose_board,
        draw_board,
        format_board,
        format_pdf,
        format_svg,
    )

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


@opt.command()
def photos(
    folder: Path = opt.argument("DIR", type=opt.FILE),
    board: Path = opt.path("File of the board, by loopcal board.", required=True),
    poses: Path | None = opt.path(
        "Table of the poses, such as poses.csv. Pictures have its names of poses, or their "
        "order, or its column 'picture' names them.  [default: names of the pictures]"
    ),
    mount: str = opt.option(
        "What the platform carries.", type=click.Choice(("board", "camera")), default="board"
    ),
    sigma: float = opt.option(
        "Noise of u and v.",
        type=opt.NumberRange(0.0, math.inf, min_open=True, max_open=True),
        default=0.1,
        metavar="PX",
    ),
    most_blur: float = opt.option(
        "Blur of edges above which a picture is left out.",
        of="loopcal.io.pictures:BLUR",
        type=opt.NumberRange(0.0, math.inf, min_open=True, max_open=True),
        metavar="PX",
    ),
    workers: int | None = opt.option(
        "Processes that compute.  [default: the number of processors]", type=opt.Count("WORKERS", 1)
    ),
    output: Path = opt.path(
        "Measurement file to write. The page of all pictures gets its name with .html.",
        "-o",
        required=True,
    ),
    force: bool = opt.force("the output files"),
) -> Output:
    """Find the corners of a printed board in all pictures of the folder DIR, by OpenCV.

    loopcal leaves out blurred, mirrored and zoomed pictures and other sizes, each with a reason.
    EXIF data give the first focal length. The command needs the extra 'camera'.

    Examples:
      loopcal photos pictures --board board.yaml -o points.csv
      loopcal photos pictures --board board.yaml --poses poses.csv -o points.csv
    """
    from contextlib import closing

    from loopcal.cli.commands.study_commands import count_processors
    from loopcal.environment import import_optional
    from loopcal.errors import DataError
    from loopcal.findings import report_finding
    from loopcal.io import pictures as of
    from loopcal.io.core.csv_table import refuse_settings_beside
    from loopcal.io.core.outputs import refuse_outputs, restore_on_failure
    from loopcal.io.core.text_file import write_text
    from loopcal.io.pictures import load_dictionary, read_board
    from loopcal.studies.executors import Processes, Serial

    if output.suffix != ".csv":
        raise DataError(f"{output} becomes a measurement file. Use a name that ends in .csv")
    page_file, known = output.with_suffix(".html"), read_board(board)
    paths = of.list_pictures(folder)
    refuse_outputs((output, page_file), (board, poses, *paths), force)
    refuse_settings_beside(output)
    load_dictionary(import_optional("cv2", "camera"), known)
    if known.measured is None:
        terminal.print_finding("pictures.board-unmeasured")
    names, beside = of.name_poses(paths, poses), of.refer_to_poses(poses, output)
    count = min(workers or count_processors(), len(paths))
    executor = Serial() if count == 1 else Processes(count)
    tasks = [of.PictureTask(path, known, most_blur) for path in paths]
    lost = report_finding("pictures.unreadable", reason="it stopped the process that read it")
    found: dict[Path, of.Picture] = {}
    with (
        terminal.TerminalProgress("finding corners") as progress,
        closing(executor.map_blocks(of.examine_picture, tasks)) as answers,
    ):
        for answer in answers:
            path = answer.task.path
            found[path] = answer.result or of.Picture(path, fault=lost)
            progress(len(found), len(paths), "finding corners")
    pictures = of.compare_pictures([found[path] for path in paths])
    settings: dict[str, Any] = {"noise": dict.fromkeys("uv", f"{sigma:g} px")}
    settings |= {"noise_source": "assumed", "mount": mount, **beside}
    text = of.format_pictures(known, pictures, names, settings)
    with restore_on_failure((output, page_file)):
        write_text(output, text)
        write_text(page_file, of.format_contact_sheet(pictures, names))
    used = [picture for picture in pictures if picture.fault is None]
    shown = [
        {"picture": p.path, "pose": names[p.path], "corners": len(p.corners)}
        | {"blur": p.blur, "focal": p.focal, "fault": p.fault}
        for p in pictures
    ]
    document = {"measurements": output, "sheet": page_file, "used": len(used), "pictures": shown}
    lines = [f"{picture.path.name}: {of.describe_picture(picture)}" for picture in pictures]
    files = [] if beside else ["poses.csv"]
    page = [
        "\n".join(lines),
        f"{output}: {len(used)} of {len(pictures)} pictures, {page_file} shows them",
        suggest_command("calibrate", "ROBOT", *files, output, "-o", "run"),
    ]
    return Output(document, lambda: page)
