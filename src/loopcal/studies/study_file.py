# SPDX-License-Identifier: Apache-2.0
"""Read study files: YAML in which each number states its unit; errors name the line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from loopcal.errors import LoopcalError
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import Location, YamlFile, read_yaml, refuse_unknown_keys
from loopcal.io.robot.robot_file import check_format, find_robot_file, get_source, load_robot
from loopcal.studies.specification import (
    FACTORS,
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    Question,
    Robot,
    Scores,
)
from loopcal.studies.study import BLOCK, Study

T = TypeVar("T")

WHAT, FORMAT = "study file", 1

LEVELS: dict[str, type] = {
    "instruments": InstrumentLevel,
    "noise": NoiseLevel,
    "poses": PosesLevel,
    "errors": ErrorsLevel,
    "methods": MethodLevel,
    "effects": EffectsLevel,
}
"""Factor -> record of its levels."""


@dataclass(frozen=True)
class StudyHead:
    """The keys of a study file that are no factor."""

    title: str
    seed: int = 1
    replicates: int = 1000
    block: int = BLOCK
    scores: Scores = field(default_factory=Scores)
    questions: dict[str, Question] = field(default_factory=dict)


@dataclass(frozen=True)
class QuickTier:
    """What the quick tier replaces: numbers, and whole factors of the same form."""

    replicates: int = 100
    block: int = BLOCK


def load_study(path: str | Path, quick: bool = False) -> Study:
    """Read a study file.

    Parameters
    ----------
    path : the file; robots are shipped ones, or files beside it.
    quick : whether to apply the replacements of its `quick:` part, or a tenth of the replicates.

    Raises
    ------
    FileError : what does not fit, at its line.
    """
    file = read_yaml(path, WHAT)
    check_format(file, FORMAT)
    content = dict(file.content)
    head_keys = ("title", "seed", "replicates", "block", "scores", "questions")
    refuse_unknown_keys(file, list(content), ["format", *head_keys, *FACTORS, "quick"])
    head = read_record(
        file, {key: content[key] for key in head_keys if key in content}, StudyHead, None
    )
    factors: dict[str, Any] = {
        key: read_levels(file, content[key], LEVELS[key], (key,))
        for key in FACTORS
        if key in content and key != "robots"
    }
    robots = read_robots(file, content.get("robots"))
    order = tuple(FACTORS[key] for key in content if key in FACTORS)
    return Study(
        head.title,
        robots,
        head.seed,
        head.replicates,
        head.block,
        order=order,
        scores=head.scores,
        questions=head.questions,
        **factors,
    )


def read_levels(file: YamlFile, node: Any, record: type[T], location: Location) -> dict[str, T]:
    """Return name -> level of a factor: a mapping of records, or a list of plain values."""
    plain = getattr(record, "PLAIN", None)
    if isinstance(node, dict):
        items: list[tuple[str, Any, Location]] = [
            (name, value, (*location, name)) for name, value in node.items()
        ]
    else:
        nodes = node if isinstance(node, list) else [node]
        items = [
            (_name(value), value, (*location, i) if isinstance(node, list) else location)
            for i, value in enumerate(nodes)
        ]
    levels: dict[str, T] = {}
    for name, value, place in items:
        content = value
        if not isinstance(value, dict):
            if plain is None:
                raise file.error(f"{name!r} must be a mapping of settings", place)
            content = {plain: value}
        if name in levels:
            raise file.error(f"two levels are named {name!r}; rename or remove one", place)
        levels[name] = read_record(file, content, record, None, place)
    if not levels:
        raise file.error(f"{location[0]!r} has no level; give at least one", location)
    return levels


def read_robots(file: YamlFile, node: Any) -> dict[str, Robot]:
    """Return name -> robot of the key `robots`: shipped names or files beside the study file."""
    if node is None:
        raise file.error("this study names no robot; add for example 'robots: [hexapod-42]'")
    if isinstance(node, dict):
        items = [(name, value, ("robots", name)) for name, value in node.items()]
    else:
        nodes = node if isinstance(node, list) else [node]
        items = [(Path(str(v)).stem, v, ("robots", i)) for i, v in enumerate(nodes)]
    robots = {}
    for name, value, place in items:
        beside = file.path.parent / str(value)
        source = beside if beside.is_file() else value
        try:
            robot = load_robot(find_robot_file(source))
        except LoopcalError as error:
            raise file.error(str(error), place) from None
        robots[name] = Robot(str(value), get_source(robot).file.text)
    return robots


def _name(value: Any) -> str:
    """Return the name of a plain level."""
    return f"{value:g}" if isinstance(value, float) else str(value)
