# SPDX-License-Identifier: Apache-2.0
"""Published studies, repeated: the same steps by this library's functions, published numbers beside
computed ones.

One folder a paper: `published.yaml` (the printed numbers and statements, with their place),
`text.yaml` (claims, captions, sentences), `study.yaml` (its simulation as a study file, see
paper_studies.py), `steps.py` (what the paper does) and `study.py` with

    compute(seed, trials, progress) -> results, with `results.printed` as read from published.yaml
    present(results, seed) -> comparisons, tables, verdicts, figures

A further paper is one more folder and its line in PAPERS. Nothing is imported before a paper is
run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, suggest_names

if TYPE_CHECKING:
    from loopcal.papers.reproduction import Reproduction

TRIALS = 50
"""Drawings of noise behind each statistical number, unless more are asked for."""


@dataclass(frozen=True)
class Paper:
    """A published study that can be repeated.

    Attributes
    ----------
    name : on the command line. title, source : what it is and where it stands.
    module : of `compute` and `present`; imported when it is run.
    studies : robot -> its study file in the folder of the paper; that of the first one is adapted
        to other robots.
    """

    name: str
    title: str
    source: str
    module: str
    studies: Mapping[str, str]

    def run(
        self, seed: int = 0, trials: int = TRIALS, progress: Callable[[str], None] | None = None
    ) -> Reproduction:
        """Repeat the study.

        Parameters
        ----------
        seed : of all that is drawn. trials : drawings behind each statistical number, at least 2.
        progress : is told in a few words what is being done.

        Raises
        ------
        DataError
            A seed below zero, or fewer than 2 trials.
        """
        if seed < 0 or trials < 2:
            raise DataError(
                f"seed {seed} with {trials} trials: give a seed of 0 or more, and 2 trials or more"
            )
        compute = import_module(self.module).compute
        return self.present(compute(seed, trials, progress or (lambda _: None)), seed, trials)

    def present(self, results: Any, seed: int, trials: int) -> Reproduction:
        """Return computed results as tables, verdicts and figures."""
        from loopcal.papers.reproduction import Reproduction
        from loopcal.papers.wording import read_wording

        module = import_module(self.module)
        about = read_wording(str(module.__file__)).about(source=results.printed.source)
        settings = {"seed": seed, "trials": trials}
        content = module.present(results, seed)
        return Reproduction(self.name, self.title, self.source, about, settings, *content)


PAPERS: Mapping[str, Paper] = {
    paper.name: paper
    for paper in (
        Paper(
            "hexapod-42",
            "Numerical simulation of the calibration of a hexapod: 42 parameters, 10 poses, least "
            "squares leg by leg",
            "study of a 6-DOF parallel mechanism with 42 kinematic parameters, read as text; no "
            "DOI known to us",
            "loopcal.papers.hexapod_42.study",
            {"hexapod-42": "study.yaml"},
        ),
        Paper(
            "tsvd-2016",
            "Least squares, ridge estimation and truncated SVD compared on a 3-PRS and an "
            "RU-PUS-PRS manipulator",
            "Advances in Mechanical Engineering 2016, doi:10.1177/1687814016667908",
            "loopcal.papers.tsvd_2016.study",
            {"3-prs": "study_3_prs.yaml", "ru-pus-prs": "study_ru_pus_prs.yaml"},
        ),
        Paper(
            "cmm-constraint-2011",
            "A hexapod calibrated from points on planes and perpendicular lines, held by a "
            "coordinate measuring machine",
            "International Journal of Advanced Robotic Systems 2011, doi:10.5772/45684",
            "loopcal.papers.cmm_constraint_2011.study",
            {"hexapod-nategh-agheli": "study.yaml"},
        ),
    )
}


def paper(name: str) -> Paper:
    """Return a paper by its name.

    Raises
    ------
    DataError
        No paper is called so.
    """
    if name not in PAPERS:
        raise DataError(
            f"{name!r} is not a paper that can be repeated{suggest_names(name, PAPERS)}; known are "
            f"{', '.join(PAPERS)}"
        )
    return PAPERS[name]
