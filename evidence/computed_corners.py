# SPDX-License-Identifier: Apache-2.0
"""The machines of `rendered_pictures` with computed corners in place of rendered pictures: the
error of the corners is that which rendered pictures show, and many machines take minutes.

The printer stretches the board along x and y, a caliper measures it with an error, and the fit
takes the noise from the residuals. The standard deviation of stated over true comes from drawing
machines with replacement.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import loopcal as lc
from evidence import rendered_pictures as rendered
from evidence.printed_board import (
    COLUMNS,
    FORMATS,
    MACHINES_BY_NAME,
    SEED,
    Outcome,
    Sample,
    build_scene,
    judge,
    name_lens,
    summarize,
)
from loopcal.io.pictures import Picture, format_pictures, read_board
from loopcal.io.robot.robot_file import load_robot
from tests.io.boards import project_corners

MACHINES = {"hexapod": 80, "delta": 20, "five-bar": 20}
CORNER_SD = 0.015  # [px]
FOCAL = 3111.0  # by EXIF [px]
DRAWS = 2000


def examine_machine(name: str, seed: int) -> Outcome:
    """Return what a calibration with computed corners shows."""
    machine, rng = MACHINES_BY_NAME[name], np.random.default_rng([SEED, seed])
    n = rendered.POSES
    scene = build_scene(machine, rng, n + rendered.PREDICTED)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        pictured = replace(scene, q=scene.q[:n], x=scene.x[:n])
        board, scale = rendered.write_files(folder, machine, pictured, rng, draw=False)
        noise, pictures = np.random.default_rng([7, seed]), []
        for i, x in enumerate(pictured.x):
            true = project_corners(
                board, scene.locate_board(machine, x), scene.lens, (scale[0], scale[1])
            )
            pixels = true + CORNER_SD * noise.standard_normal(true.shape)
            seen = np.flatnonzero(((pixels > 0) & (pixels < rendered.SIZE)).all(axis=1))
            path = Path(f"p{i}.jpg")
            pictures.append(Picture(path, rendered.SIZE, FOCAL, seen, pixels[seen]))
        names = {picture.path: picture.path.stem for picture in pictures}
        known = read_board(folder / "board.yaml")
        text = format_pictures(known, pictures, names, "board", 0.1, {"poses": "poses.csv"})
        (folder / "points.csv").write_text(text)
        data = lc.load_measurements(folder / "points.csv", load_robot(machine.robot))
    return judge(
        machine, Sample(data, scene.truth, scene.q[n:], scene.x[n:], name_lens(scene.lens))
    )


def collect() -> dict[str, Any]:
    """Return the table of all machines."""
    rows = []
    for name, count in MACHINES.items():
        outcomes = [examine_machine(name, seed) for seed in range(count)]
        stated, true = (np.array([getattr(o, key) for o in outcomes]) for key in ("stated", "true"))
        drawn = np.random.default_rng(SEED).integers(0, count, (DRAWS, count))
        ratios = np.sqrt(stated[drawn].mean(axis=1) / true[drawn].mean(axis=1))
        row = summarize(name, outcomes)
        rows.append([*row[:6], float(ratios.std()), *row[6:]])
    columns, formats = list(COLUMNS), list(FORMATS)
    columns[6:6], formats[6:6] = ["its sd"], [".2f"]
    return {
        "seeds": [SEED, 7],
        "tables": {"computed": {"columns": columns, "formats": formats, "rows": rows}},
    }


QUICK = {"MACHINES": {"hexapod": 2, "delta": 2, "five-bar": 2}}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds for two machines each."""
    for row in tables["computed"]["rows"]:
        assert row[2] > 75.0, row
        assert row[7] < 0.1, row
