# SPDX-License-Identifier: Apache-2.0
"""The papers that can be repeated, and their study files.

A further paper is one more folder and its entry in PAPERS. The folder has `published.yaml` (the
printed numbers and statements, with their place), `sizes.yaml` (sizes that are ours), `text.yaml`
(claims, captions, sentences), `study.yaml` (its simulation as a study file), `steps.py` (what the
paper does), and `results.py` with compute(seed, trials, progress, case) -> results, of which
compare_tables, make_tables, judge_claims, make_figures and list_replaced (sizes that another robot
replaces) yield what a page shows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, MechanismError, suggest_names
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.findings import report_finding
from loopcal.findings.wording import list_names, round_to_digits
from loopcal.io.robot.robot_file import find_robot_file, load_robot
from loopcal.mechanism.workspace import list_tilt_rings

if TYPE_CHECKING:
    from loopcal.mechanism.model import Mechanism
    from loopcal.papers.reproduction import Reproduction
    from loopcal.studies.specification.levels import ErrorsLevel
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
    # whether it identifies leg by leg, in steps that end where max dQint is at most epsilon
    is_per_leg: bool = False

    @property
    def package(self) -> str:
        """Its folder."""
        return f"loopcal.papers.{self.name.replace('-', '_')}"

    def run(
        self,
        seed: int = 0,
        trials: int = TRIALS,
        progress: Callable[[str], None] | None = None,
        robot: str | Path | None = None,
        epsilon: float | None = None,
    ) -> Reproduction:
        """Repeat the study.

        trials : drawings behind each statistical number. progress : receives a few words on each
        step. robot : another robot, or its file, that takes the place of those of the paper.
        epsilon : in place of the limit at which the steps of a paper with such a rule end.

        Raises
        ------
        DataError : a seed below zero, fewer than 2 trials, a robot that does not fit the study, or
            an epsilon for a study without this rule.
        FileError : the robot cannot be read.
        """
        if seed < 0 or trials < 2:
            raise DataError(
                f"seed {seed} with {trials} trials: give a seed of 0 or more, and 2 trials or more"
            )
        compute = import_module(f"{self.package}.results").compute
        case = self.make_case(robot, epsilon)
        results = compute(seed, trials, progress or (lambda _: None), case)
        return self.present(results, seed, trials, case)

    def make_case(self, robot: str | Path | None = None, epsilon: float | None = None) -> StudyCase:
        """Return the study of a robot, or its file; by default that of the robots of the paper.

        Raises DataError: as `run`. EstimationError: legs that cannot be identified one by one.
        """
        if epsilon is not None and not (self.is_per_leg and 0.0 < epsilon < math.inf):
            able = ", ".join(paper.name for paper in PAPERS.values() if paper.is_per_leg)
            raise DataError(
                f"epsilon is {epsilon:g} for {self.name}; give a finite number above 0, for {able} "
                "only"
            )
        if robot is None or str(robot) in self.studies:
            return StudyCase(self, str(robot or ""), epsilon=epsilon)
        other = load_robot(robot)
        if self.is_per_leg:
            from loopcal.studies.simulation.published_steps import check_legs

            check_legs(other)
        table = other.parameters
        if not (table.free * [bool(entry.tolerance) for entry in table.entries]).any():
            raise DataError(report_finding("data.no-errors-drawn", robot=other.name))
        return StudyCase(self, str(robot), other, epsilon)

    def present(
        self, results: Any, seed: int, trials: int, case: StudyCase | None = None
    ) -> Reproduction:
        """Return computed results as tables, verdicts and figures; case : that they belong to."""
        from loopcal.papers.published import PaperText
        from loopcal.papers.reproduction import Content, Reproduction

        module, case = import_module(f"{self.package}.results"), case or StudyCase(self)
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
            PaperText(str(module.__file__)).about(case.robot.name if case.robot else ""),
            {"seed": seed, "trials": trials}
            | ({"robot": case.source} if case.robot else {})
            | ({"epsilon": case.epsilon} if case.epsilon else {}),
            Content(*(tuple(part(results)) for part in parts)),
            (*case.list_replaced(), *module.list_replaced(results)),
        )

    def load_study(self, robot: str = "") -> Study:
        """Return the study of a robot of the paper; default: of the first."""
        from loopcal.studies.files.study_file import load_study

        name = self.studies[robot or next(iter(self.studies))]
        return load_study(Path(str(files(self.package) / name)))

    def read_file(self, name: str) -> str:
        """Return the text of a file of the paper."""
        return (files(self.package) / name).read_text("utf-8")


@dataclass(frozen=True)
class StudyCase:
    """The study of a paper with its own robots, or with another one.

    source : name or file of the robot that was asked for, "" for none. robot : it, None for those
    of the paper. epsilon : in place of the limit of the paper's rule.
    """

    paper: Paper
    source: str = ""
    robot: Mechanism | None = None
    epsilon: float | None = None

    def load_study(self, name: str = "") -> Study:
        """Return the study of the robot; name : which robot of the paper, by default the first."""
        from loopcal.io.core.yaml_file import parse_yaml
        from loopcal.studies.files.study_file import parse_study

        if self.robot is None:
            return self.paper.load_study(name)
        path = find_robot_file(self.source).parent / "study.yaml"  # is not written
        made = make_paper_study(self.paper, path, self.source)
        return parse_study(parse_yaml(made.files[path], path, "study file"))

    def list_replaced(self) -> tuple[str, ...]:
        """Return sentences that state which sizes of the study the other robot replaces."""
        if self.robot is None:
            if len(robots := self.paper.studies) == 1 or not self.source:
                return ()
            names = list_names(tuple(robots))
            return (f"{self.source} is a robot of the paper: the study runs for all, {names}.",)
        first, other = self.paper.load_study(), self.load_study()
        (of_paper,) = first.robots.values()
        nominal, robot = load_robot(of_paper.source), self.robot
        sentences = [f"The robot is {robot.name} in place of {nominal.name}."]
        for level, of_other in zip(first.poses.values(), other.poses.values(), strict=True):
            if level != of_other:
                sentences.append(
                    f"{of_other.count} poses are drawn from the workspace of {robot.name} in place "
                    f"of the {level.count} of the study."
                )
            elif of_other.choice == "tilts":
                sentences.append(
                    f"{of_other.count} poses lie on rings of equal tilt in the workspace of "
                    f"{robot.name} in place of that of {nominal.name}."
                )
        for kind in ("instruments", "methods"):
            before, after = (list(getattr(study, kind)) for study in (first, other))
            names = [[n for n in a if n not in b] for a, b in ((before, after), (after, before))]
            left, new = map(_say_levels, names)
            if left and new:
                sentences.append(f"The {kind} {new} take the place of {left}.")
            elif left or new:
                sentences.append(f"The {kind} {left or new} are {'left out' if left else 'added'}.")
        for level, (of_robot, of_other) in zip(
            first.errors.values(), other.errors.items(), strict=True
        ):
            before, after = describe_errors(nominal, level), describe_errors(robot, of_other)
            which = f" ({of_robot})" * (len(first.errors) > 1)
            sentences.append(
                f"True machines{which} have drawn errors with standard deviations of {after} in "
                f"place of {before}{'' if level.deviations else f' of {nominal.name}'}."
            )
        return tuple(sentences)


def _say_levels(names: Sequence[str]) -> str:
    """Return names of levels, from the first to the last where they are many."""
    if len(names) > 3:
        return f"{names[0]} to {names[-1]}"
    return list_names(names)


def describe_errors(robot: Mechanism, level: ErrorsLevel) -> str:
    """Return the standard deviations of the errors of a level, such as `0.1 to 1 mm`."""
    if level.deviations:
        return "those of one machine"
    free = select_free_parameters(robot)
    factor, symbols = free.display()
    sd = free.tolerance * level.tolerance_factor * level.error_factor / factor
    parts = []
    for unit in dict.fromkeys(symbols):
        of_unit = sd[[symbol == unit for symbol in symbols]]
        ends = dict.fromkeys(round_to_digits(value) for value in (of_unit.min(), of_unit.max()))
        parts.append(f"{' to '.join(ends)} {unit}".rstrip())
    return list_names(parts)


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
            is_per_leg=True,
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
    """

    files: Mapping[Path, str]
    robot: str

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

    Another robot gets as many poses of its own workspace in place of a file of poses (three more
    than its parameters need by the count of equations, at least), and of rings that it does not
    reach, errors by its tolerances in place of the errors of one machine, as many
    directions of truncated SVD as it has parameters, and no angles that it does not have.
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
    changes, loaded = {"robots": f"robots: [{quote_robot(path, wanted)}]"}, load_robot(wanted)
    if file is not None:
        count = max(len(poses.splitlines()) - 1, -(-int(loaded.parameters.free.sum()) // 6) + 3)
        changes["poses"] = f"poses: [{count}]  # drawn from the workspace"
    if re.search(r"^ +deviations:", text, re.MULTILINE):
        changes["errors"] = ANY_ERRORS
    if (rings := re.search(r"count: (\d+), choice: tilts", text)) is not None:
        try:
            list_tilt_rings(loaded.nominal, int(rings[1]))
        except MechanismError:
            changes["poses"] = f"poses: [{rings[1]}]  # drawn from the workspace"
    if "unused: [psi]" in text and not loaded.can_rotate:
        changes["instruments"] = _keep_position(text)
    for key, content in changes.items():
        text = _replace_key(text, key, content)
    text = _list_directions(text, len(select_free_parameters(loaded)))
    title = quote_scalar(f"{paper.name} with {loaded.name}")
    text = re.sub(r"^title: .*$", lambda _: f"title: {title}", text, flags=re.MULTILINE)
    # a factor of tolerances is no size of the paper
    text = re.sub(
        r"^  [^:\n]+: (\{tolerance_factor: ([\d.]+)\})$",
        lambda found: f"  {found[2]} tolerance{'s' * (found[2] != '1')}: {found[1]}",
        text,
        flags=re.MULTILINE,
    )
    return PaperStudyFile({path: text}, wanted)


def _keep_position(text: str) -> str:
    """Return the instruments of a study file without angles, for a platform that cannot rotate."""
    found = re.search(r"(distribution: \w+, sigma_position: [^,}\n]+)", text)
    assert found is not None
    return f"instruments:\n  3-DOF: {{kinds: [component], components: [x, y, z], {found[1]}}}"


def _list_directions(text: str, parameters: int) -> str:
    """Return the text of a study file in which truncated SVD keeps each number of directions from
    one fewer than the parameters to 1, if it lists such numbers.
    """
    listed = re.compile(r"(?:^  [^:\n]*\d+: \{[^\n]*keep: \d+\}\n)+", re.MULTILINE)

    def list_all(found: re.Match[str]) -> str:
        line = found[0].splitlines(keepends=True)[0]
        numbers = range(parameters - 1, 0, -1)
        return "".join(re.sub(r"\d+(?=: \{|\})", str(number), line) for number in numbers)

    return listed.sub(list_all, text)


def _replace_key(text: str, key: str, content: str) -> str:
    """Return the text of a study file in which one key, with the comment above it, is replaced."""
    pattern = rf"(?:^#[^\n]*\n)*^{key}:[^\n]*\n(?:^[ ][^\n]*\n)*"
    changed, count = re.subn(pattern, lambda _: f"{content}\n", text, flags=re.MULTILINE)
    assert count == 1, key
    return changed
