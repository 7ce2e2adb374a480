# SPDX-License-Identifier: Apache-2.0
"""A study whose driver and workers are killed at random times, compared with an undisturbed one.

Each time, the driver is started with `--resume`, and after some new blocks a random process of it,
the driver itself or a worker, is killed (kill -9). After a killed worker the driver continues, and
is killed a little later. At last the study is run to its end. Its blocks are compared, to the last
bit, with those of a study that was computed at once.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from loopcal.studies.files.store import NAME, read_store
from loopcal.studies.files.study_folder import load_specification

REPLICATES, BLOCK, CELLS = 12_500, 50, 4
KILLS = 20
WORKERS = 2
LONGEST_WAIT = 120.0
"""Seconds within which a driver stores a new block."""

PAUSE = 0.25
"""Longest time between a new block and the kill, as a share of the time of the blocks between two
kills: fast computers do not finish the study before its last kill.
"""

STUDY = """\
format: 1
title: A study that is interrupted
seed: 3
replicates: {replicates}
block: {block}
robots: [five-bar]
instruments:
  tracker: {{kinds: [position], sigma_position: 20 um}}
poses: [6, 8]
methods: [map, least-squares]
scores: {{held_out: 1}}
"""

Contents = dict[tuple[str, int], bytes]
"""Cell and number of a block -> its scores."""


def examine(place: Path, replicates: int, block: int, kills: int, seed: int = 5) -> dict[str, int]:
    """Return what became of a study that was disturbed.

    Parameters
    ----------
    place : an empty folder. kills : processes to kill. seed : of the times and victims.

    Returns
    -------
    blocks : of the study. lost, doubled, different : of the disturbed one. driver_kills,
    worker_kills : by victim.
    """
    file, rng = place / "study.yaml", random.Random(seed)
    file.write_text(STUDY.format(replicates=replicates, block=block))
    whole, folder = place / "undisturbed", place / "disturbed"
    _start(file, whole).communicate()
    counts = {"driver_kills": 0, "worker_kills": 0}
    share = len(read_contents(whole)) // (kills + 1)
    longest = PAUSE * share * measure_block(whole)
    for kill in range(kills):
        with _start(file, folder) as driver:
            _wait_for_blocks(driver, folder, count_blocks(folder) + rng.randint(1, max(share, 1)))
            time.sleep(rng.uniform(0.0, longest))
            workers = list_workers(driver.pid) if kill % 2 else []
            if workers and _kill(rng.choice(workers)):
                counts["worker_kills"] += 1
                _wait_for_blocks(driver, folder, count_blocks(folder) + 1)
            elif driver.poll() is None:
                counts["driver_kills"] += 1
            driver.kill()
    out, _ = _start(file, folder).communicate()
    expected, got = read_contents(whole), read_contents(folder)
    assert f"{len(expected)} of {len(expected)} blocks" in out, out
    return {
        "blocks": len(expected),
        "lost": len(expected.keys() - got.keys()),
        "doubled": count_blocks(folder) - len(got),
        "different": sum(expected[key] != got.get(key) for key in expected),
        **counts,
    }


def read_contents(folder: Path) -> Contents:
    """Return every stored block, by its cell and number."""
    with read_store(folder) as store:
        return {
            (str(cell), number): scores.tobytes()
            for cell in load_specification(store).cells
            for number, scores in store.read_blocks(cell.levels)
        }


def count_blocks(folder: Path) -> int:
    """Return the number of stored rows; 0 where there is no store."""
    if not (folder / NAME).exists():
        return 0
    with read_store(folder) as store:
        return int(store.connection.execute("SELECT count(*) FROM blocks").fetchone()[0])


def measure_block(folder: Path) -> float:
    """Return the mean time of the computation of a stored block [s]."""
    with read_store(folder) as store:
        return float(store.connection.execute("SELECT avg(seconds) FROM blocks").fetchone()[0])


def list_workers(driver: int) -> list[int]:
    """Return the worker processes of a driver, without what else Python starts."""
    children = _read_process(f"{driver}/task/{driver}/children").split()
    names = {int(child): _read_process(f"{int(child)}/cmdline") for child in children}
    return [child for child, name in names.items() if b"spawn_main" in name]


def _read_process(name: str) -> bytes:
    """Return a file of /proc; empty where the process has ended meanwhile."""
    try:
        return Path("/proc", name).read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def _kill(process: int) -> bool:
    """Kill a process; return whether it had not ended before."""
    try:
        os.kill(process, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def _start(file: Path, folder: Path) -> subprocess.Popen[str]:
    """Start a driver that continues the study."""
    options: Sequence[str] = ("-o", str(folder), "--resume", "--workers", str(WORKERS))
    words = [sys.executable, "-m", "loopcal", "study", "run", str(file), *options]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True, start_new_session=True)


def _wait_for_blocks(driver: subprocess.Popen[str], folder: Path, count: int) -> None:
    """Wait until a number of blocks is stored, or the driver has stored all and ended."""
    end, before = time.monotonic() + LONGEST_WAIT, -1
    while (stored := count_blocks(folder)) < count and driver.poll() is None:
        if stored > before:
            end, before = time.monotonic() + LONGEST_WAIT, stored
        assert time.monotonic() < end, "no new block"
        time.sleep(0.02)


def collect() -> dict[str, Any]:
    """Return the counts of the full-size study."""
    with tempfile.TemporaryDirectory() as place:
        counts = examine(Path(place), REPLICATES, BLOCK, KILLS)
    columns = ["trials", *counts]
    row = [REPLICATES * CELLS, *counts.values()]
    table = {
        "columns": [c.replace("_", " ") for c in columns],
        "formats": ["d"] * len(row),
        "rows": [row],
    }
    return {"counts": counts, "tables": {"outcome": table}}
