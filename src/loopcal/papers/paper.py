# SPDX-License-Identifier: Apache-2.0
"""The papers that can be repeated, and their study files.

A further paper is one more folder and its entry in PAPERS. The folder has `published.yaml` (the
printed numbers and statements, with their place), `sizes.yaml` (sizes that are ours), `text.yaml`
(claims, captions, sentences), `study.yaml` (its simulation as a study file), `steps.py` (what the
paper does), and `results.py` with compute(seed, trials, progress) -> results, of which
compare_tables, make_tables, judge_claims and make_figures yield what a page shows.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, suggest_names

if TYPE_CHECKING:
    from loopcal.papers.reproduction import Reproduction
    from loopcal.studies.specification.study import Study

TRIALS = 50
"""Drawings of noise behind each statistical number, unless more are asked for."""

ANY_ERRORS = "errors: [1]  # normal errors, in tolerances of the robot file"
"""In place of errors that are those of one robot."""


@dataclass(frozen=True)
class Paper:
    """A published study that can be repeated; name : on the command line. studies : robot -> its
    study file in the folder; that of the first is adapted to other robots.
    """

    name: str
    title: str
    source: str
    studies: Mapping[str, str]

    @property
    def package(self) -> str:
        """Its folder."""
        return f"loopcal.papers.{self.name.replace('-', '_')}"

    def run(
        self, seed: int = 0, trials: int = TRIALS, progress: Callable[[str], None] | None = None
    ) -> Reproduction:
        """Repeat the study.

        trials : drawings behind each statistical number. progress : receives a few words on each
        step. DataError for a seed below zero or fewer than 2 trials.
        """
        if seed < 0 or trials < 2:
            raise DataError(
                f"seed {seed} with {trials} trials: give a seed of 0 or more, and 2 trials or more"
            )
        compute = import_module(f"{self.package}.results").compute
        return self.present(compute(seed, trials, progress or (lambda _: None)), seed, trials)

    def present(self, results: Any, seed: int, trials: int) -> Reproduction:
        """Return computed results as tables, verdicts and figures."""
        from loopcal.papers.published import PaperText
        from loopcal.papers.reproduction import Content, Reproduction

        module = import_module(f"{self.package}.results")
        parts = (
            module.compare_tables,
            module.make_tables,
            module.judge_claims,
            module.make_figures,
        )
        return Reproduction(
            self.name,
            self.title,
            self.source,
            PaperText(str(module.__file__)).about(),
            {"seed": seed, "trials": trials},
            Content(*(tuple(part(results)) for part in parts)),
        )

    def load_study(self, robot: str = "") -> Study:
        """Return the study of a robot of the paper; default: of the first."""
        from loopcal.studies.files.study_file import load_study

        name = self.studies[robot or next(iter(self.studies))]
        return load_study(Path(str(files(self.package) / name)))

    def read_file(self, name: str) -> str:
        """Return the text of a file of the paper."""
        return (files(self.package) / name).read_text("utf-8")


PAPERS: Mapping[str, Paper] = {
    paper.name: paper
    for paper in (
        Paper(
            "hexapod-42",
            "Numerical simulation of the calibration of a hexapod: 42 parameters, 10 poses, least "
            "squares leg by leg",
            "study of a 6-DOF parallel mechanism with 42 kinematic parameters, read as text; no "
            "DOI known to us",
            {"hexapod-42": "study.yaml"},
        ),
        Paper(
            "tsvd-2016",
            "Least squares, ridge estimation and truncated SVD compared on a 3-PRS and an "
            "RU-PUS-PRS manipulator",
            "Advances in Mechanical Engineering 2016, doi:10.1177/1687814016667908",
            {"3-prs": "study_3_prs.yaml", "ru-pus-prs": "study_ru_pus_prs.yaml"},
        ),
        Paper(
            "cmm-constraint-2011",
            "A hexapod calibrated from points on planes and perpendicular lines, held by a "
            "coordinate measuring machine",
            "International Journal of Advanced Robotic Systems 2011, doi:10.5772/45684",
            {"hexapod-nategh-agheli": "study.yaml"},
        ),
    )
}


def find_paper(name: str) -> Paper:
    """Return a paper by its name; DataError where no paper is called so."""
    if name not in PAPERS:
        raise DataError(
            f"{name!r} is not a paper that can be repeated{suggest_names(name, PAPERS)}; known are "
            f"{', '.join(PAPERS)}"
        )
    return PAPERS[name]


@dataclass(frozen=True)
class PaperStudyFile:
    """A study file to write.

    files : path -> text, of the study file and, beside it, of its poses. robot : that it names.
    replaced : keys of the study that belonged to the robot of the paper and were replaced, too.
    """

    files: Mapping[Path, str]
    robot: str
    replaced: tuple[str, ...] = ()

    @property
    def outputs(self) -> tuple[Path, ...]:
        """Files that are written."""
        return tuple(self.files)

    def write(self) -> None:
        """Write the files; FileError where that is impossible."""
        from loopcal.io.core.outputs import restore_on_failure
        from loopcal.io.core.text_file import write_text

        with restore_on_failure(self.outputs):
            for path in reversed(self.outputs):
                write_text(path, self.files[path])


def make_paper_study(paper: Paper, path: Path, robot: str | None = None) -> PaperStudyFile:
    """Return the study file of a paper, for its robot or for another one.

    Another robot gets as many poses of its own workspace in place of a file of poses, and errors by
    its tolerances in place of the errors of one machine.
    """
    from loopcal.io.core.yaml_file import quote_scalar
    from loopcal.studies.files.study_file import quote_robot

    first = next(iter(paper.studies))
    wanted = first if robot is None else robot
    text = paper.read_file(paper.studies.get(wanted, paper.studies[first]))
    file = re.search(r"^  .*\{file: ([\w.]+)\}$", text, re.MULTILINE)
    poses = "" if file is None else paper.read_file(file[1])
    if wanted in paper.studies:
        if file is None:
            return PaperStudyFile({path: text}, wanted)
        beside = path.with_name(f"{path.stem}-poses.csv")
        text = text.replace(f"{{file: {file[1]}}}", f"{{file: {quote_scalar(beside.name)}}}")
        return PaperStudyFile({path: text, beside: poses}, wanted)
    changes = {"robots": f"robots: [{quote_robot(path, wanted)}]"}
    if file is not None:
        count = len(poses.splitlines()) - 1
        changes["poses"] = f"poses: [{count}]  # drawn from the workspace"
    if re.search(r"^ +deviations:", text, re.MULTILINE):
        changes["errors"] = ANY_ERRORS
    for key, content in changes.items():
        text = _replace_key(text, key, content)
    return PaperStudyFile({path: text}, wanted, tuple(changes)[1:])


def _replace_key(text: str, key: str, content: str) -> str:
    """Return the text of a study file in which one key, with the comment above it, is replaced."""
    pattern = rf"(?:^#[^\n]*\n)*^{key}:[^\n]*\n(?:^[ ][^\n]*\n)*"
    changed, count = re.subn(pattern, lambda _: f"{content}\n", text, flags=re.MULTILINE)
    assert count == 1, key
    return changed
