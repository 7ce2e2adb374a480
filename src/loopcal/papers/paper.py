# SPDX-License-Identifier: Apache-2.0
"""The papers that can be repeated, and their study files.

A further paper is one more folder and its entry in PAPERS. The folder has `published.yaml` (the
printed numbers and statements, with their place), `sizes.yaml` (sizes that are ours), `text.yaml`
(claims, captions, sentences), `study.yaml` (its simulation as a study file), and `results.py` with
what the paper does and compute(seed, trials, progress, case) -> results, of which compare_tables,
make_tables, judge_claims, make_figures and list_replaced (sizes that another robot replaces) yield
what a page shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, MechanismError, suggest_names
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.findings.wording import list_names, round_to_digits
from loopcal.io.core.yaml_file import format_yaml, parse_yaml, quote_scalar
from loopcal.io.robot.robot_file import find_robot_file, load_robot
from loopcal.mechanism.workspace import list_tilt_rings

if TYPE_CHECKING:
    from loopcal.mechanism.model import Mechanism
    from loopcal.papers.published import Reproduction
    from loopcal.studies.specification import ErrorsLevel, Study

STUDY = "study.yaml"  # file of the study of a paper
TRIALS = 50  # drawings of noise behind each statistical number, unless more are asked for


@dataclass(frozen=True)
class Paper:
    """A published study that can be repeated; name : on the command line. robots : of the paper,
    the study file of the first is adapted to others.
    """

    name: str
    title: str
    source: str
    robots: tuple[str, ...]
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
                f"epsilon is {epsilon:g} for {self.name}. Give a finite number above 0, for {able} "
                "only"
            )
        if robot is None or str(robot) in self.robots:
            return StudyCase(self, str(robot or ""), epsilon=epsilon)
        other = load_robot(robot)
        if self.is_per_leg:
            from loopcal.studies.simulation.published_steps import check_legs

            check_legs(other)
        table = other.parameters
        if not (table.free * [bool(entry.tolerance) for entry in table.entries]).any():
            raise DataError.of("data.no-errors-drawn", robot=other.name)
        return StudyCase(self, str(robot), other, epsilon)

    def present(
        self, results: Any, seed: int, trials: int, case: StudyCase | None = None
    ) -> Reproduction:
        """Return computed results as tables, verdicts and figures; case : that they belong to."""
        from loopcal.papers.published import Content, PaperText, Reproduction

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
        """Return the study of a robot, or its file; default: of the first one of the paper."""
        from loopcal.studies.files.study_file import load_study, parse_study

        if robot in ("", self.robots[0]):
            return load_study(Path(str(files(self.package) / STUDY)))
        path = find_robot_file(robot).parent / STUDY  # is not written
        made = make_paper_study(self, path, robot)
        return parse_study(parse_yaml(made[path], path, "study file"))

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

    def load_study(self) -> Study:
        """Return the study of the robot, by default of the first one of the paper."""
        return self.paper.load_study(self.source if self.robot else "")

    def list_replaced(self) -> tuple[str, ...]:
        """Return sentences that state which sizes of the study the other robot replaces."""
        if self.robot is None:
            if len(robots := self.paper.robots) == 1 or not self.source:
                return ()
            names = list_names(robots)
            return (f"{self.source} is a robot of the paper: the study runs for all, {names}.",)
        first, other = self.paper.load_study(), self.load_study()
        (of_paper,) = first.robots.values()
        nominal, robot = load_robot(of_paper.source), self.robot
        sentences = [f"The robot is {robot.name} in place of {nominal.name}."]
        for level, of_other in zip(first.poses.values(), other.poses.values(), strict=True):
            if level != of_other:
                sentences.append(
                    f"{of_other.count} poses come from the workspace of {robot.name} in place "
                    f"of the {level.count} of the study."
                )
            elif of_other.choice == "tilts":
                sentences.append(
                    f"{of_other.count} poses lie on rings of equal tilt in the workspace of "
                    f"{robot.name} in place of {nominal.name}."
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
        return "one machine"
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
            ("hexapod-42",),
            is_per_leg=True,
        ),
        Paper(
            "tsvd-2016",
            "Least squares, ridge estimation and truncated SVD compared on a 3-PRS and an "
            "RU-PUS-PRS manipulator",
            "Advances in Mechanical Engineering 2016, doi:10.1177/1687814016667908",
            ("3-prs", "ru-pus-prs"),
        ),
        Paper(
            "cmm-constraint-2011",
            "A hexapod calibrated from points on planes and perpendicular lines, held by a "
            "coordinate measuring machine",
            "Yu, Li, Chen: Kinematic Calibration of Parallel Robots for Docking Mechanism Motion "
            "Simulation, International Journal of Advanced Robotic Systems 2011, "
            "doi:10.5772/45684",
            ("hexapod-nategh-agheli",),
        ),
    )
}


def find_paper(name: str) -> Paper:
    """Return a paper by its name; DataError where no paper is called so."""
    if name not in PAPERS:
        raise DataError(
            f"{name!r} is not a paper that can be repeated{suggest_names(name, PAPERS)}. Known: "
            f"{', '.join(PAPERS)}"
        )
    return PAPERS[name]


def make_paper_study(paper: Paper, path: Path, robot: str | None = None) -> dict[Path, str]:
    """Return the study file of a paper, for its robot or for another one (see `adapt_content`), and
    the file of its poses beside it, as path -> text.
    """
    from loopcal.studies.files.study_file import name_robot

    wanted, text = robot or paper.robots[0], paper.read_file(STUDY)
    content = parse_yaml(text, path, "study file").content
    (poses,) = content["poses"].values()
    file = poses.get("file", "")
    table = paper.read_file(file) if file else ""
    if wanted == paper.robots[0]:
        if not file:
            return {path: text}
        beside = path.with_name(f"{path.stem}-poses.csv")
        text = text.replace(f"{{file: {file}}}", f"{{file: {quote_scalar(beside.name)}}}")
        return {path: text, beside: table}
    other = load_robot(wanted)
    content |= {"title": f"{paper.name} with {other.name}", "robots": [name_robot(path, wanted)]}
    content |= adapt_content(content, other, max(len(table.splitlines()) - 1, 0))
    head = text[: text.index("format:")]
    return {path: head + format_yaml(content)}


def adapt_content(content: Mapping[str, Any], robot: Mechanism, listed: int) -> dict[str, Any]:
    """Return the keys of a study file of a paper that differ for another robot.

    It gets as many poses of its own workspace in place of those `listed` in a file (three more than
    its parameters need by the count of equations, at least), and of rings that it does not reach,
    errors by its spreads in place of the errors of one machine, as many directions of
    truncated SVD as it has parameters, and no angles that it does not have.
    """
    changed = dict[str, Any]()
    (poses,) = content["poses"].values()
    if listed:
        changed["poses"] = [max(listed, -(-int(robot.parameters.free.sum()) // 6) + 3)]
    elif poses["choice"] == "tilts":
        try:
            list_tilt_rings(robot.nominal, poses["count"])
        except MechanismError:
            changed["poses"] = [poses["count"]]
    errors: Mapping[str, Mapping[str, Any]] = content["errors"]
    if any("deviations" in level for level in errors.values()):
        changed["errors"] = [1]
    elif all("tolerance_factor" in level for level in errors.values()):  # is no size of the paper
        sizes = [level["tolerance_factor"] for level in errors.values()]
        changed["errors"] = {
            f"{x} tolerance{'s' * (x != 1)}": {"tolerance_factor": x} for x in sizes
        }
    (level, *others) = content["instruments"].values()
    if any("unused" in other for other in others) and not robot.can_rotate:
        position = {key: level[key] for key in ("kinds", "distribution", "sigma_position")}
        changed["instruments"] = {"3-DOF": position | {"components": ["x", "y", "z"]}}
    methods: Mapping[str, Mapping[str, Any]] = content["methods"]
    kept = {name: level for name, level in methods.items() if "keep" in level}
    if kept:
        (name, level), count = next(iter(kept.items())), len(select_free_parameters(robot))
        every = {name.replace(str(level["keep"]), str(k)): {**level, "keep": k}
                 for k in range(count - 1, 0, -1)}  # fmt: skip
        changed["methods"] = {n: m for n, m in methods.items() if n not in kept} | every
    return changed
