# SPDX-License-Identifier: Apache-2.0
"""Rendered pictures of 12 megapixels calibrate the machines of `printed_board`: board file, JPEG
with EXIF, `loopcal photos`, and the calibration of its measurement file, as a user does it.

The printer stretches the board along x and y, and a caliper measures it with an error. Pictures
have perspective, distortion, blur, noise and darker edges.
"""

from __future__ import annotations

import tempfile
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image as Picture

import loopcal as lc
from evidence.printed_board import (
    COLUMNS,
    CORNERS,
    FORMATS,
    MACHINES_BY_NAME,
    SEED,
    Array,
    Machine,
    Outcome,
    Sample,
    Scene,
    build_scene,
    judge,
    name_lens,
    summarize,
)
from loopcal.cli.entry_point import main
from loopcal.io.pictures import CALIPER_SD, Board, choose_board, format_board
from loopcal.io.robot.robot_file import load_robot
from loopcal.units import Dimension
from tests.io.boards import project_corners, render

MACHINES, POSES, PREDICTED = 20, 15, 15
SIZE = (4000, 3000)
PRINT_SD = 0.003  # of the scales of the print
FILM = 28  # EXIF: focal length for film of 35 mm, in whole millimeters as phones write it [mm]


def write_files(
    folder: Path, machine: Machine, scene: Scene, rng: np.random.Generator, draw: bool = True
) -> tuple[Board, Array]:
    """Write board file, poses.csv and pictures of a scene; return the board and its scales.

    draw : whether to write pictures.
    """
    scale = 1.0 + PRINT_SD * rng.standard_normal(2)
    board = choose_board(CORNERS[0] + 1, CORNERS[1] + 1, machine.square)
    x, y = np.array(board.marks) * scale + CALIPER_SD * rng.standard_normal(2)
    head, _, tail = format_board(board).partition("# measured: ")
    lengths = f"measured: [{1e3 * x:.2f} mm, {1e3 * y:.2f} mm]\n"
    (folder / "board.yaml").write_text(head + lengths + tail.partition("\n")[2])
    drives = load_robot(machine.robot).actuators
    units = [{Dimension.LENGTH: "m", Dimension.ANGLE: "rad"}[drive.dimension] for drive in drives]
    names = [f"{drive.name} [{unit}]" for drive, unit in zip(drives, units, strict=True)]
    lines = [",".join(("pose", *names))]
    (folder / "pictures").mkdir()
    exif = Picture.Exif()
    exif.get_ifd(0x8769)[0xA405] = FILM
    for i, (q, at) in enumerate(zip(scene.q, scene.x, strict=True)):
        seen = scene.locate_board(machine, at)
        if draw:
            picture = render(
                board, seen, scene.lens, SIZE, seed=i, scale=tuple(scale), blur=0.5, fine=1
            )
            path = folder / "pictures" / f"p{i}.jpg"
            Picture.fromarray(picture).save(path, quality=95, exif=exif)
        lines.append(",".join([f"p{i}", *(f"{value:.12g}" for value in q)]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return board, scale


def examine_machine(name: str, seed: int) -> tuple[Outcome, float, float]:
    """Return what a calibration with rendered pictures shows, the share of the pictures that are
    used, and the error of the corners (rms of u and v) [px].
    """
    machine, rng = MACHINES_BY_NAME[name], np.random.default_rng([SEED, seed])
    scene = build_scene(machine, rng, POSES + PREDICTED)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        pictured = replace(scene, q=scene.q[:POSES], x=scene.x[:POSES])
        board, scale = write_files(folder, machine, pictured, rng)
        words = ["photos", folder / "pictures", "--board", folder / "board.yaml", "--workers", "1"]
        words += ["--poses", folder / "poses.csv", "-o", folder / "points.csv"]
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            assert main([str(word) for word in words]) == 0
        data = lc.load_measurements(folder / "points.csv", load_robot(machine.robot))
    (rows,) = data.observations
    poses = [int(data.labels[i][1:]) for i in rows.rows]
    seen = [scene.locate_board(machine, at) for at in pictured.x]
    true = np.array([project_corners(board, T, scene.lens, tuple(scale)) for T in seen])
    errors = rows.measured[:, 1:] - true[poses, rows.measured[:, 0].astype(int)]
    rest = scene.q[POSES:], scene.x[POSES:]
    outcome = judge(machine, Sample(data, scene.truth, *rest, name_lens(scene.lens)))
    return outcome, len(data.labels) / POSES, float(np.sqrt((errors**2).mean()))


def collect() -> dict[str, Any]:
    """Return the table of all machines."""
    cv2.setNumThreads(1)  # one process, one processor
    rows = []
    for name in MACHINES_BY_NAME:
        found = [examine_machine(name, seed) for seed in range(MACHINES)]
        outcomes, used, errors = zip(*found, strict=True)
        row = summarize(name, list(outcomes))
        shares = 100.0 * float(np.mean(used)), float(np.sqrt(np.mean(np.square(errors))))
        rows.append([*row[:2], *shares, *row[2:]])
    columns, formats = list(COLUMNS), list(FORMATS)
    columns[2:2] = ["pictures used [%]", "error of corners (rms of u and v) [px]"]
    formats[2:2] = [".0f", ".3f"]
    return {
        "seeds": [SEED, SEED],
        "tables": {"rendered": {"columns": columns, "formats": formats, "rows": rows}},
    }


QUICK = {"MACHINES": 1, "POSES": 10}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds for one machine each."""
    for row in tables["rendered"]["rows"]:
        assert row[2] > 80.0
        assert row[3] < 0.03
        assert row[4] > 75.0
