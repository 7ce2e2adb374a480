# SPDX-License-Identifier: Apache-2.0
"""A study whose driver and workers are killed at random times, compared with an undisturbed one.

Each time, the driver is started with `--resume`, and after some new blocks a random process of it,
the driver itself or a worker, is killed (kill -9). After a killed worker the driver continues, and
is killed a little later. At last the study is run to its end. Its blocks are compared, to the last
bit, with those of a study that was computed at once.

Processes are killed at numbers of stored blocks, so the speed of the computer does not matter. A
study that ends before its last kill gets more replicates.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopcal.studies.executors import Executor, Processes
from loopcal.studies.files.store import NAME, load_specification, read_store
from loopcal.studies.running import count_blocks, read_source, run_study

REPLICATES, BLOCK = 12_500, 50
KILLS = 20
WORKERS = 2
LONGEST_WAIT = 900.0
"""Seconds without a new block after which a driver that lives has stopped working."""

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


@dataclass(frozen=True)
class Disturbance:
    """What is done to a study.

    Parameters
    ----------
    replicates : trials of each cell. block : trials of a block. kills : processes to kill.
    seed : of the times and victims.
    """

    replicates: int
    block: int
    kills: int
    seed: int = 5


def examine(place: Path, disturbance: Disturbance, executor: Executor) -> dict[str, int]:
    """Return what became of a study that was disturbed.

    Parameters
    ----------
    place : an empty folder. executor : computes the rest of the disturbed study after the last
        kill, and the undisturbed one.

    Returns
    -------
    trials, blocks : of the study. lost, doubled, different : blocks of the disturbed one.
    driver_kills, worker_kills : by victim.
    """
    whole, folder = place / "undisturbed", place / "disturbed"
    file, counts = place / "study.yaml", {"driver_kills": 0, "worker_kills": 0}
    rng, replicates = random.Random(disturbance.seed), disturbance.replicates
    while (kills := sum(counts.values())) < disturbance.kills:
        file.write_text(STUDY.format(replicates=replicates, block=disturbance.block))
        left = count_blocks(read_source(file).study) - count_rows(folder)
        count = rng.randint(1, max(left // (disturbance.kills - kills + 1), 1))
        with _start(file, folder) as driver:
            victim = _disturb(driver, folder, count, rng, is_worker=kills % 2 == 1)
        if victim is None:
            replicates += disturbance.replicates
        else:
            counts[f"{victim}_kills"] += 1
    source = read_source(file)
    assert run_study(source, folder, executor, resume=True).is_complete
    run_study(source, whole, executor)
    expected, got = read_contents(whole), read_contents(folder)
    return {
        "trials": len(source.study.cells) * replicates,
        "blocks": len(expected),
        "lost": len(expected.keys() - got.keys()),
        "doubled": count_rows(folder) - len(got),
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


def count_rows(folder: Path) -> int:
    """Return the number of stored rows; 0 where there is no store."""
    if not (folder / NAME).exists():
        return 0
    with read_store(folder) as store:
        return int(store.connection.execute("SELECT count(*) FROM blocks").fetchone()[0])


def list_workers(driver: int) -> list[int]:
    """Return the worker processes of a driver, without what else Python starts."""
    children = _read_process(f"{driver}/task/{driver}/children").split()
    names = {int(child): _read_process(f"{int(child)}/cmdline") for child in children}
    return [child for child, name in names.items() if b"popen_loky" in name]


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


def _disturb(
    driver: subprocess.Popen[str], folder: Path, count: int, rng: random.Random, is_worker: bool
) -> str | None:
    """Kill a driver after a number of new blocks, or first a worker of it; return the victim, or
    None where the driver ends before.
    """
    begin = time.monotonic()
    if not _wait_for_blocks(driver, folder, count):
        return None
    time.sleep(rng.uniform(0.0, (time.monotonic() - begin) / count / 10))
    victim = "driver"
    if is_worker:
        workers = list_workers(driver.pid)
        if not workers or not _kill(rng.choice(workers)):
            driver.kill()
            return None
        victim = "worker"
        _wait_for_blocks(driver, folder, 1)
    elif driver.poll() is not None:
        return None
    driver.kill()
    return victim


def _start(file: Path, folder: Path) -> subprocess.Popen[str]:
    """Start a driver that continues the study."""
    options: Sequence[str] = ("-o", str(folder), "--resume", "--workers", str(WORKERS))
    words = [sys.executable, "-m", "loopcal", "study", "run", str(file), *options]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, text=True, start_new_session=True)


def _wait_for_blocks(driver: subprocess.Popen[str], folder: Path, count: int) -> bool:
    """Wait until a driver has stored a number of new blocks; return whether it still lives."""
    first = before = count_rows(folder)
    end = time.monotonic() + LONGEST_WAIT
    while (stored := count_rows(folder)) < first + count and driver.poll() is None:
        if stored > before:
            end, before = time.monotonic() + LONGEST_WAIT, stored
        assert time.monotonic() < end, "no new block"
        time.sleep(0.01)
    assert driver.poll() in (None, 0), "the driver failed"
    return driver.poll() is None


QUICK = {"REPLICATES": 500, "KILLS": 2}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    row = dict(zip(tables["outcome"]["columns"], tables["outcome"]["rows"][0], strict=True))
    assert row["lost"] == row["doubled"] == row["different"] == 0
    assert row["driver kills"] + row["worker kills"] == KILLS


def collect() -> dict[str, Any]:
    """Return the counts of the full-size study."""
    disturbance = Disturbance(REPLICATES, BLOCK, KILLS)
    with tempfile.TemporaryDirectory() as place:
        counts = examine(Path(place), disturbance, Processes(WORKERS))
    table = {
        "columns": [name.replace("_", " ") for name in counts],
        "formats": ["d"] * len(counts),
        "rows": [list(counts.values())],
    }
    return {"counts": counts, "tables": {"outcome": table}}
