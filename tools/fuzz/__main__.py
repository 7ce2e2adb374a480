# SPDX-License-Identifier: Apache-2.0
"""Run random inputs through the command line and report what is wrong with the answers.

    python -m tools.fuzz --count 1000                 the seeds 1 to 1000
    python -m tools.fuzz --count 1000 --add fuzz.json  the next 1000, counted with the earlier ones
    python -m tools.fuzz --count 1000 --studies       only study files and folders
    python -m tools.fuzz --replay 4711                one input: its files, command line and answer

The exit code is 1 where something is wrong.
"""

import argparse
import json
import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from tools.fuzz.campaign import Summary, run_campaign
from tools.fuzz.cases import Maker
from tools.fuzz.corpus import build_corpus
from tools.fuzz.execution import prepare_worker, run_case
from tools.fuzz.study_corpus import build_study_corpus
from tools.fuzz.verdict import judge, judge_surroundings


def main(arguments: list[str] | None = None) -> int:
    """Run inputs, or repeat one; return 1 if there are finds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=300, help="number of inputs")
    parser.add_argument("--seed", type=int, default=1, help="first seed")
    parser.add_argument("--workers", type=int, default=1, help="processes at the same time")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after this time")
    parser.add_argument("--add", type=Path, help="JSON file of counts to write, and to go on from")
    parser.add_argument("--replay", type=int, metavar="SEED", help="run one input and show it")
    parser.add_argument("--keep", type=Path, help="with --replay: folder for its files")
    parser.add_argument("--studies", action="store_true", help="inputs of `loopcal study` alone")
    options = parser.parse_args(arguments)
    maker = Maker([*([] if options.studies else build_corpus()), *build_study_corpus()])
    if options.replay is not None:
        return replay(maker, options.replay, options.keep)
    summary = Summary()
    first = options.seed
    if options.add is not None and options.add.exists():
        summary = Summary.from_json(json.loads(options.add.read_text("utf-8")))
        first = max((last for _, last in summary.seeds), default=0) + 1
    run(
        maker,
        summary,
        range(first, first + options.count),
        options.workers,
        options.minutes,
        options.add,
    )
    print(
        f"fuzz: {summary.inputs} inputs, {summary.cpu:.0f} s of processor time, "
        f"{len(summary.finds)} finds"
    )
    return 1 if summary.finds else 0


def run(
    maker: Maker, summary: Summary, seeds: range, workers: int, minutes: float, file: Path | None
) -> None:
    """Run the inputs of some seeds, print new finds, and write the counts now and then."""
    begin = time.monotonic()
    state = {"written": begin}

    def write() -> None:
        if file is not None:
            temporary = file.with_suffix(".tmp")
            temporary.write_text(json.dumps(summary.to_json(), indent=1) + "\n", "utf-8")
            temporary.replace(file)

    def report(answer: dict[str, Any], new: list[dict[str, str]]) -> None:
        for find in new:
            print(f"seed {answer['seed']}: {find['signature']}", flush=True)
        if time.monotonic() - state["written"] > 60:
            state["written"] = time.monotonic()
            write()

    run_campaign(
        maker,
        iter(seeds),
        workers,
        summary,
        report,
        lambda: time.monotonic() - begin > 60 * minutes,
    )
    write()


def replay(maker: Maker, seed: int, keep: Path | None) -> int:
    """Run one input in this process; print its command line, its damage and the answer."""
    import tempfile

    case = maker.make(seed)
    prepare_worker()
    with tempfile.TemporaryDirectory() as base:
        folder = Path(base) / "area" / "case"
        outcome = run_case(case, folder)
        finds = judge(case, outcome, folder)
        if case.foreign or case.variables:
            plain = run_case(replace(case, foreign={}, variables={}), folder)
            finds += judge_surroundings(case, outcome, plain)
    print(f"machine {case.machine}: loopcal {shlex.join(case.words)}")
    print(f"damage: {', '.join(case.damage)}")
    print(f"exit code {outcome.code}, {outcome.cpu:.2f} s")
    print(f"--- stdout\n{outcome.out[-1500:]}\n--- stderr\n{outcome.err[-1500:]}")
    if keep is not None:
        from tools.fuzz.execution import write_case

        keep.mkdir(parents=True, exist_ok=True)
        write_case(case, keep)
    for find in finds:
        print(f"--- find: {find.signature}\n{find.detail[-3000:]}")
    return 1 if finds else 0


if __name__ == "__main__":
    sys.exit(main())
