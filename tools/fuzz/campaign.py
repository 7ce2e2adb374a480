# SPDX-License-Identifier: Apache-2.0
"""Run many inputs in processes of their own, and count what happened.

Each worker is a fork of this process, which has imported everything and made the corpus once. It
runs a chunk of inputs and ends; where it dies, the input that it was at is a find.
"""

from __future__ import annotations

import json
import os
import re
import select
import shutil
import signal
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from tools.fuzz.cases import Case, Maker
from tools.fuzz.commands import describe, name_command
from tools.fuzz.execution import CPU_LIMIT, Outcome, prepare_worker, run_case
from tools.fuzz.verdict import Find, judge, judge_surroundings

CHUNK = 100
"""Inputs that one worker runs before it is replaced by a fresh one."""

PLACE = re.compile(r"(?<![\w.])/(?:[^\s/\"']+/)+(?=[^\s/\"']+/[^\s/\"']+/[^\s/\"']+\.py\b)")
"""The beginning of a long path of a source file, which differs from machine to machine."""

Report = Callable[[dict[str, Any], list[dict[str, str]]], None]
"""Is called with each answer and its new finds."""

COUNTED = ("commands", "options", "damage", "exit_codes")


@dataclass
class Summary:
    """Counts of a campaign.

    Attributes
    ----------
    inputs : number of inputs. cpu : seconds of all. slowest : seconds, and its seed.
    counts : by name of the count, then by what is counted.
    finds : by signature: count, seeds of the first ones, and the details of the first.
    """

    inputs: int = 0
    cpu: float = 0.0
    slowest: tuple[float, int] = (0.0, -1)
    seeds: list[list[int]] = field(default_factory=list)
    counts: dict[str, Counter[str]] = field(
        default_factory=lambda: {name: Counter() for name in COUNTED}
    )
    finds: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add(self, answer: dict[str, Any]) -> list[dict[str, str]]:
        """Count the answer of a worker; return the finds that are new."""
        self.inputs += 1
        self.cpu += answer["cpu"]
        self.slowest = max(self.slowest, (answer["cpu"], answer["seed"]))
        for name in COUNTED:
            self.counts[name].update(answer[name])
        new = []
        for find in answer["finds"]:
            if find["signature"] not in self.finds:
                self.finds[find["signature"]] = {"count": 0, "seeds": [], "detail": find["detail"]}
                new.append(find)
            known = self.finds[find["signature"]]
            known["count"] += 1
            known["seeds"] = [*known["seeds"], answer["seed"]][:5]
        return new

    def to_json(self) -> dict[str, Any]:
        """Return the counts as a JSON document."""
        return {
            "inputs": self.inputs,
            "seeds": join_ranges(self.seeds),
            "cpu_seconds": round(self.cpu, 1),
            "slowest_seconds": round(self.slowest[0], 2),
            "slowest_seed": self.slowest[1],
            **{name: dict(sorted(self.counts[name].items())) for name in COUNTED},
            "finds": dict(sorted(self.finds.items(), key=lambda pair: -pair[1]["count"])),
        }

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Summary:
        """Return the counts of a document, so that a campaign can go on."""
        return cls(
            inputs=document["inputs"],
            cpu=document["cpu_seconds"],
            slowest=(document["slowest_seconds"], document["slowest_seed"]),
            seeds=document["seeds"],
            counts={name: Counter(document[name]) for name in COUNTED},
            finds=document["finds"],
        )


def join_ranges(ranges: list[list[int]]) -> list[list[int]]:
    """Return ranges [first, last] in order, with neighbors joined."""
    joined: list[list[int]] = []
    for first, last in sorted(ranges):
        if joined and first <= joined[-1][1] + 1:
            joined[-1][1] = max(joined[-1][1], last)
        else:
            joined.append([first, last])
    return joined


def answer_case(case: Case, maker: Maker, folder: Path) -> dict[str, Any]:
    """Run an input and return what is counted about it."""
    outcome = run_case(case, folder)
    finds = judge(case, outcome, folder)
    if case.foreign or case.variables:
        plain = run_case(replace(case, foreign={}, variables={}), folder)
        finds += judge_surroundings(case, outcome, plain)
    return _make_answer(case, maker, outcome, finds)


def _make_answer(case: Case, maker: Maker, outcome: Outcome, finds: list[Find]) -> dict[str, Any]:
    return {
        "seed": case.seed,
        "cpu": round(outcome.cpu, 4),
        "commands": [name_command(case.words, maker.commands)],
        "options": describe(case.words, maker.commands),
        "damage": sorted(set(case.damage)) or ["(none)"],
        "exit_codes": [str(outcome.code)],
        "finds": [{"signature": f.signature, "detail": PLACE.sub("", f.detail)} for f in finds],
    }


@dataclass
class Worker:
    """A forked process, the seeds that it has not begun, and the one that it is at."""

    process: int
    pipe: int
    seeds: list[int]
    at: int | None = None
    received: bytes = b""

    def read_lines(self) -> list[bytes] | None:
        """Return the lines that have arrived; None where the process has ended."""
        new = os.read(self.pipe, 1 << 16)
        *lines, self.received = (self.received + new).split(b"\n")
        return lines if new else None


def run_campaign(
    maker: Maker,
    seeds: Iterator[int],
    workers: int,
    summary: Summary,
    report: Report,
    is_over: Callable[[], bool] = lambda: False,
) -> None:
    """Run inputs until the seeds or the time are used up; count them in `summary`."""
    memory = Path("/dev/shm")  # a folder in memory, where there is one
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as base:
        running: list[Worker] = []
        ended = False
        while running or not ended:
            while not ended and len(running) < workers:
                chunk = [] if is_over() else list(islice(seeds, CHUNK))
                ended = not chunk
                if chunk:
                    running.append(_start_worker(maker, chunk, Path(base)))
            ready, _, _ = (
                select.select([w.pipe for w in running], [], [], 5.0) if running else ([], [], [])
            )
            for worker in [w for w in running if w.pipe in ready]:
                lines = worker.read_lines()
                for line in lines or ():
                    _take_line(worker, json.loads(line), summary, report)
                if lines is None:
                    running.remove(worker)
                    answer = _bury(worker, maker)
                    if answer is not None:
                        _count(summary, answer, report)
                    if worker.seeds:
                        running.append(_start_worker(maker, worker.seeds, Path(base)))


def _take_line(worker: Worker, document: dict[str, Any], summary: Summary, report: Report) -> None:
    """Note at which input a worker is, or count its answer."""
    if "begin" in document:
        worker.seeds.remove(document["begin"])
        worker.at = document["begin"]
    else:
        worker.at = None
        _count(summary, document, report)


def _count(summary: Summary, answer: dict[str, Any], report: Report) -> None:
    summary.seeds = join_ranges([*summary.seeds, [answer["seed"], answer["seed"]]])
    report(answer, summary.add(answer))


def _start_worker(maker: Maker, seeds: list[int], base: Path) -> Worker:
    """Fork a process that answers the inputs of some seeds, one line of JSON each."""
    reading, writing = os.pipe()
    process = os.fork()
    if process:
        os.close(writing)
        return Worker(process, reading, list(seeds))
    try:
        os.close(reading)
        prepare_worker()
        place = base / str(os.getpid()) / "area"
        with os.fdopen(writing, "w", encoding="utf-8") as pipe:
            for seed in seeds:
                print(json.dumps({"begin": seed}), file=pipe, flush=True)
                answer = answer_case(maker.make(seed), maker, place / "case")
                print(json.dumps(answer), file=pipe, flush=True)
        shutil.rmtree(place.parent, ignore_errors=True)
        os._exit(0)
    finally:
        os._exit(70)


def _bury(worker: Worker, maker: Maker) -> dict[str, Any] | None:
    """Wait for a process that ended; return an answer for the input at which it died."""
    os.close(worker.pipe)
    _, status = os.waitpid(worker.process, 0)
    if worker.at is None:
        return None
    case = maker.make(worker.at)
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    how = signal.Signals(number).name if number else f"exit status {os.WEXITSTATUS(status)}"
    cpu = float(2 * CPU_LIMIT) if number == signal.SIGXCPU else 0.0
    words = " ".join(case.words)
    find = Find(
        "died", f"{case.words[0] if case.words else ''} {how}", f"{how}: {words}; {case.damage}"
    )
    return _make_answer(case, maker, Outcome(cpu=cpu), [find])
