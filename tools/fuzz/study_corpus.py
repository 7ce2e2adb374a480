# SPDX-License-Identifier: Apache-2.0
"""A study of a five-bar that takes milliseconds, the folders of its jobs, and commands for them.

It is a corpus of its own, so that the inputs of the other machines keep their seeds.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path

from tools.fuzz.corpus import ROOT, Line, Machine, collect_files, run_command, work_in_folder

STUDY = """\
format: 1
title: A study
seed: 3
replicates: 2
block: 1
robots: [robot.yaml]
instruments:
  tracker: {kinds: [position], sigma_position: 20 um}
  camera: {kinds: [component], components: [x, y], sigma_position: 60 um, distribution: uniform}
noise: [1, 2]
poses:
  four: 4
  given: {file: poses.csv}
errors:
  usual: {error_factor: 1.5, tolerances: {"west.motor.*": 0.2 mm}}
methods: [auto, map]
effects:
  more: {noise: 2, outliers: {share: 0.1, size: 5}, drift: 10 um, thermal: {rise: 2}}
scores: {held_out: 2}
questions:
  noise: {factor: noise, score: position, limit: 0.1 mm, wanted: largest}
quick: {replicates: 1, instruments: {tracker: {kinds: [position]}}}
"""
POSES = "pose,x [mm],y [mm]\na,10,320\nb,-50,350\nc,0,300\nd,30,310\n"

LINES = """
    6 study check study.yaml
    2 study check study.yaml --quick --json
    8 study run study.yaml -o out --workers 1
    4 study run study.yaml -o out --quick --workers 1
    3 study run study.yaml -o results --resume --workers 1
    1 study run study.yaml -o out --cells 2/3 --workers 1
    3 study status results
    1 study summary results
    0.3 study summary results --score position --against poses
    3 study ask results --smallest noise --limit 100um
    1 study ask results --largest noise --limit 1mm --score position_max --json
    3 study export results -o out.csv
    3 study extend results --replicates 3 --workers 1
    3 study merge results part -o out
    2 study merge part -o results
    3 study replay results 1/2 -o out
    1 study new new.yaml --robot five-bar
"""

LEFT_OUT = frozenset({"--dask", "--ray", "--workers"})
"""Options that start programs or reach a network, which the fuzzer refuses."""


def build_study_corpus() -> list[Machine]:
    """Return the study, with its files made anew in a temporary folder."""
    processors = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {processors[os.getpid() % len(processors)]})  # so none is started
    name, words = "study", "tracker camera poses noise position rank usual 1/2 0/0 3/99 1/3 10um 0"
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        with work_in_folder(name):
            shutil.copy(ROOT / "src" / "loopcal" / "robots" / "five-bar.yaml", "robot.yaml")
            Path("study.yaml").write_text(STUDY, "utf-8")
            Path("poses.csv").write_text(POSES, "utf-8")
            run_command("study run study.yaml -o results --workers 1")
            run_command("study run study.yaml -o part --workers 1 --cells 1/3")
            run_command("study summary results")  # matplotlib also makes its own folder
        rows = [line.split() for line in LINES.strip().splitlines()]
        lines = [Line(tuple(row[1:]), float(row[0])) for row in rows]
        machine = Machine(name, lines=lines, left_out=LEFT_OUT)
        machine.words += words.split()
        for log in Path(name).rglob("*.sqlite-*"):
            log.unlink()
        return [collect_files(machine, name)]
