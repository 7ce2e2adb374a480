# SPDX-License-Identifier: Apache-2.0
"""Read study files: YAML in which each number states its unit; errors name the line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from loopcal.errors import DataError, LoopcalError, MissingPackageError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.penalties import Ridge
from loopcal.io.core import yaml_file
from loopcal.io.core.records import get_field_types, read_record
from loopcal.io.core.text_file import write_text
from loopcal.io.data.measurement_file import load_poses
from loopcal.io.file_schemas import SchemaMaker
from loopcal.io.robot import robot_file
from loopcal.mechanism.model import Mechanism
from loopcal.studies import specification
from loopcal.studies.simulation.machines import (
    check_effects,
    check_surfaces,
    make_fit_options,
    make_groups,
    make_instrument,
    resolve_patterns,
)
from loopcal.studies.simulation.published_steps import check_legs

# Factor -> record of its levels, of those that are not robots.
LEVELS: Mapping[str, type] = {
    key: get_field_types(specification.CellContent)[name]
    for key, name in specification.FACTORS.items()
    if key != "robots"
}
SETTINGS = tuple(item.name for item in fields(specification.StudySettings))
QUICK = "quick"


def build_study_schema() -> dict[str, Any]:
    """Return the JSON Schema of study files."""
    make = SchemaMaker(units=False)
    whole = make.list_keys(specification.StudySettings)
    levels: dict[str, Any] = {}
    for key, record in LEVELS.items():
        stated = [make.refer(record)]
        if plain := getattr(record, "PLAIN", ""):
            stated.append(make.describe(get_field_types(record)[plain]))
        one = {"anyOf": stated}
        named = {"type": "object", "additionalProperties": one}
        levels[key] = {"anyOf": [named, {"type": ["array", "string", "number", "boolean"]}]}
    levels |= {key: {} for key in specification.FACTORS if key not in levels}
    replaced = {"type": "object", "additionalProperties": {}}
    whole["properties"] |= {"format": {"const": 1}, **levels, QUICK: replaced}
    return make.finish("loopcal study file", whole)


class StudyContent(NamedTuple):
    """The content of a study file by key, and where each key was read: for replacements of the
    quick tier, below `quick`.
    """

    file: yaml_file.YamlFile
    values: Mapping[str, Any]
    places: Mapping[str, yaml_file.Location]


def load_study(path: str | Path, quick: bool = False) -> specification.Study:
    """Read a study file.

    Parameters
    ----------
    path : the file; its robots are shipped ones, or files beside it.
    quick : make the replacements that the file states under `quick:`; where it states none, each
        cell has one block.

    Raises
    ------
    FileError : what does not fit, at its line.
    """
    return parse_study(yaml_file.read_yaml(path, "study file"), quick)


def parse_study(file: yaml_file.YamlFile, quick: bool = False) -> specification.Study:
    """Return the study of the content of a study file; parameters and errors as `load_study`."""
    robot_file.check_format(file, 1)
    yaml_file.refuse_unknown_keys(
        file, list(file.content), ["format", *SETTINGS, *specification.FACTORS, QUICK]
    )
    full = {key: value for key, value in file.content.items() if key not in ("format", QUICK)}
    whole = StudyContent(file, full, {key: (key,) for key in full})
    study, short = build_study(whole), build_study(_apply_quick_tier(whole))
    return short if quick else study


def _apply_quick_tier(content: StudyContent) -> StudyContent:
    """Return the content of a study file with the replacements of its quick tier."""
    file, stated = content.file, content.file.content.get(QUICK)
    if stated is None:
        block = content.values.get("block", specification.BLOCK)
        return StudyContent(file, {**content.values, "replicates": block}, content.places)
    if not isinstance(stated, dict):
        raise file.error(
            "'quick' must contain the settings that it replaces. Write for example 'quick: "
            "{replicates: 50}'",
            (QUICK,),
        )
    allowed = [key for key in SETTINGS if key != "title"]
    yaml_file.refuse_unknown_keys(file, list(stated), [*allowed, *specification.FACTORS], (QUICK,))
    places = {key: (QUICK, key) for key in stated}
    return StudyContent(file, {**content.values, **stated}, {**content.places, **places})


def build_study(content: StudyContent) -> specification.Study:
    """Return the study of the content of a file; raise as `load_study`."""
    file, values, places = content.file, content.values, content.places
    settings_values = {key: value for key, value in values.items() if key in SETTINGS}
    location = places["replicates"][:-1] if "replicates" in places else ()
    settings = read_record(file, settings_values, specification.StudySettings, None, location)
    robots = read_robots(content)
    factors: dict[str, Any] = {}
    for key in (key for key in LEVELS if key in values):
        record, factors[key] = LEVELS[key], {}
        plain: str = getattr(record, "PLAIN", "")
        for name, value, place in _list_items(content, key):
            if not plain and not isinstance(value, dict):
                raise file.error(
                    f"the level {name!r} of {key!r} must have settings. Write "
                    "'name: {setting: value}' lines",
                    place,
                )
            stated = value if isinstance(value, dict) else {plain: value}
            factors[key][name] = read_record(file, stated, record, None, place)
    factors["robots"] = {name: robot for name, (robot, _) in robots.items()}
    order = tuple(specification.FACTORS[key] for key in values if key in specification.FACTORS)
    study = specification.Study(**vars(settings), **factors, order=order)
    machines = [robot for _, robot in robots.values()]
    study = replace(study, poses=_load_pose_files(study, machines, content))
    check_levels(study, machines, content)
    return study


def _load_pose_files(
    study: specification.Study, robots: Sequence[Mechanism], content: StudyContent
) -> dict[str, specification.PosesLevel]:
    """Return the levels of poses, those of files with the poses of these files."""
    file, levels = content.file, dict(study.poses)
    for name, value, place in _list_items(content, "poses") if "poses" in content.values else ():
        stated = value if isinstance(value, dict) else {}
        key_place = (*place, "file")
        if "coordinates" in stated:
            key_place = (*place, "coordinates")
            raise file.error("a file gives the poses. Write 'file: poses.csv'", key_place)
        if "file" not in stated:
            continue
        if len(stated) > 1:
            raise file.error("a file of poses needs no other setting. Remove the others", key_place)
        path = yaml_file.find_file_beside(file, stated["file"], key_place)
        if path is None:
            raise file.error(f"the folder of the study file lacks {stated['file']!r}", key_place)
        try:
            read = [load_poses(path, robot).tolist() for robot in robots]
        except LoopcalError as error:
            raise file.error(f"cannot read the poses: {error}", key_place) from None
        if any(poses != read[0] for poses in read):
            raise file.error("the robots of this study read other poses from this file", key_place)
        coordinates = tuple(tuple(pose) for pose in read[0])
        levels[name] = replace(levels[name], count=len(coordinates), coordinates=coordinates)
    return levels


def read_robots(content: StudyContent) -> dict[str, tuple[specification.Robot, Mechanism]]:
    """Return name -> robot of the key `robots`: shipped names, or files beside the study file."""
    file = content.file
    if "robots" not in content.values:
        raise file.error("this study names no robot. Add for example 'robots: [hexapod-42]'")
    robots = {}
    for name, value, place in _list_items(content, "robots"):
        if not isinstance(value, str):
            raise file.error(f"the robot {name!r} must be a name or a file", place)
        try:
            path = yaml_file.find_file_beside(file, value, place) or robot_file.find_robot_file(
                value
            )
            robot = robot_file.load_robot(path)
        except MissingPackageError:
            raise
        except LoopcalError as error:
            raise file.error(f"cannot read the robot {name!r}: {error}", place) from None
        robots[name] = (specification.Robot(value, robot_file.get_source(robot).file.text), robot)
    return robots


def _list_items(content: StudyContent, key: str) -> Iterator[tuple[str, Any, yaml_file.Location]]:
    """Yield name, content and location of the levels of a factor; a plain value is its own name."""
    file, node, place = content.file, content.values[key], content.places[key]
    if isinstance(node, dict):
        items = [(name, value, (*place, name)) for name, value in node.items()]
    else:
        nodes = node if isinstance(node, list) else [node]
        places = [(*place, i) for i in range(len(nodes))] if isinstance(node, list) else [place]
        items = [(_name(file, v, p), v, p) for v, p in zip(nodes, places, strict=True)]
    if not items:
        raise file.error(f"{key!r} has no level. Give at least one", place)
    names = set()
    for name, value, level_place in items:
        if name in names:
            raise file.error(f"{key!r} has two levels {name!r}. Remove one", level_place)
        names.add(name)
        yield name, value, level_place


def _name(file: yaml_file.YamlFile, value: Any, place: yaml_file.Location) -> str:
    """Return the name of a level that is a plain value."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise file.error(
            "a level without a name must be a number or a word. Write 'name: {setting: value}'",
            place,
        )
    return Path(value).stem if isinstance(value, str) and "/" in value else str(value)


def check_levels(
    study: specification.Study, robots: Sequence[Mechanism], content: StudyContent
) -> None:
    """Refuse levels that no block could be computed with, at their lines."""
    for key, check in (
        ("instruments", lambda level: make_instrument(level, specification.NoiseLevel())),
        ("poses", lambda level: _check_surfaces(level, study, robots)),
        ("methods", lambda level: _check_method(level, study, robots)),
        ("errors", lambda level: _check_errors(level, robots)),
        ("questions", lambda question: specification.check_question(study, question)),
    ):
        for i, (name, level) in enumerate(getattr(study, key).items()):
            place = content.places.get(key, ())
            node = content.values.get(key)
            step = (name,) if isinstance(node, dict) else (i,) if isinstance(node, list) else ()
            try:
                check(level)
            except LoopcalError as error:
                raise content.file.error(f"{name!r} of {key!r}: {error}", (*place, *step)) from None


def _check_surfaces(
    level: specification.PosesLevel, study: specification.Study, robots: Sequence[Mechanism]
) -> None:
    """Raise LoopcalError where points on surfaces do not fit robots, instruments or effects."""
    if level.is_on_surfaces:
        for robot in robots:
            make_groups(robot, level)
        for instrument in study.instruments.values():
            check_surfaces(make_instrument(instrument, specification.NoiseLevel()))
        for effects in study.effects.values():
            check_effects(effects)
        if study.scores.verdict:
            raise DataError("a study of points on planes and lines has no verdict. Remove it")


def _check_method(
    level: specification.MethodLevel, study: specification.Study, robots: Sequence[Mechanism]
) -> None:
    """Raise DataError where a method does not fit the robots, or one of published studies the poses
    or the scores, and EstimationError where a robot does not fit identification leg by leg.
    """
    make_fit_options(level)
    for robot in robots:
        if level.method == specification.PER_LEG:
            check_legs(robot)
        if isinstance(level.lam, Mapping):
            Ridge(level.lam).resolve(select_free_parameters(robot).names)
    if level.is_of_products and not all(poses.is_on_surfaces for poses in study.poses.values()):
        raise DataError(
            f"'rows: {level.rows}' needs points on planes and lines. Write 'choice: plane-line' "
            "for all poses, or remove it"
        )
    if level.is_published and (study.scores.verdict or study.scores.intervals == "adjusted"):
        raise DataError(
            "methods of published studies have neither a verdict nor intervals. Remove 'verdict' "
            "and 'intervals' of the scores"
        )


def _check_errors(level: specification.ErrorsLevel, robots: Sequence[Mechanism]) -> None:
    """Raise DataError where a robot has no parameter of a name, or one of another dimension, or has
    common errors, whose sizes have no lower bound.
    """
    for robot in robots:
        if level.smallest and robot.parameters.common:
            raise DataError(
                f"{robot.name} has errors that several parameters have in common, whose sum has no "
                "smallest size. Remove 'smallest'"
            )
        resolve_patterns(robot.parameters, level.tolerances)
        resolve_patterns(robot.parameters, level.deviations)


def write_template(path: Path, robot: str) -> None:
    """Write a study file with a comment for each setting, for a shipped robot or a robot file.

    Raises FileError: there is no such robot, it cannot be read, or the file cannot be written.
    """
    robot_file.load_robot(robot)
    text = (files("loopcal.studies.files") / "template.yaml").read_text("utf-8")
    write_text(
        path, text.replace("[ROBOT]", f"[{yaml_file.quote_scalar(name_robot(path, robot))}]")
    )


def name_robot(path: Path, robot: str) -> str:
    """Return how a study file names a robot: a shipped one by its name, another one by its file,
    relative to the study file where it is in the same folder or below.
    """
    if robot in robot_file.list_shipped_robots():
        return robot
    file, folder = robot_file.find_robot_file(robot).resolve(), path.parent.resolve()
    named = file.relative_to(folder) if file.is_relative_to(folder) else file
    return named.as_posix()
