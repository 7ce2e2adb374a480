# SPDX-License-Identifier: Apache-2.0
"""How long `loopcal photos` takes for a picture of 12 megapixels, by the time of the processor."""

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.bench_report import run_command
from benchmarks.harness import Metric
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.pictures import choose_board, format_board
from tests.io.boards import render

LENS = np.array([3200.0, 3206.0, 2011.0, 1488.0, 0.09, -0.16, 0.05, 0.0008, -0.0006])
PICTURES = 6
LIMIT = 3.6  # most seconds: 100 pictures in 3 minutes on two cores


def bench_photos() -> Metric:
    """Measure a folder of pictures with one process, the import of packages included."""
    board, rng = choose_board(10, 7, 0.018), np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        file, pictures = Path(folder, "board.yaml"), Path(folder, "pictures")
        file.write_text(format_board(board).replace("# measured", "measured"))
        pictures.mkdir()
        for i in range(PICTURES):
            place = make_pose(exp_so3(rng.uniform(-0.4, 0.4, 3)), np.array([-0.07, -0.04, 0.3]))
            picture = render(board, place, LENS, (4000, 3000), blur=0.9, seed=i)
            Image.fromarray(picture).save(pictures / f"{i}.jpg", quality=92)
        words = ("--board", str(file), "-o", f"{folder}/points.csv", "--workers", "1")
        seconds = run_command("photos", str(pictures), *words) / PICTURES
    note = f"mean of {PICTURES} pictures"
    return Metric("photos.picture", seconds, "s", tolerance=None, limit=LIMIT, note=note)
