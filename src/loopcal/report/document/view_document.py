# SPDX-License-Identifier: Apache-2.0
"""The page of `loopcal view`: a robot in space, of a calibration with its poses and errors."""

from __future__ import annotations

from collections.abc import Iterator

from loopcal.engine import collect_versions
from loopcal.mechanism import Mechanism
from loopcal.report.document.calibration_document import describe_maker, summarize
from loopcal.report.document.elements import Document, Element, Section
from loopcal.report.document.figures import compute_accuracy, draw_scene_picture
from loopcal.report.document.inline_svg import make_picture
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.figures import draw_scene
from loopcal.report.scene.scene import Scene
from loopcal.report.scene.scene_data import format_scene


def build_robot_view(robot: Mechanism) -> Document:
    """Return the view of a robot at home."""
    return Document(
        title=f"3-D view: {robot.name}",
        verdict="",
        summary=f"{robot.name} at its home pose.",
        made_by=describe_maker(collect_versions()),
        sections=(Section("view", "The robot", tuple(_draw_home(robot))),),
    )


def build_calibration_view(record: CalibrationRecord) -> Document:
    """Return the view of a calibration; of a fit that did not converge, the robot before it."""
    accuracy = compute_accuracy(record)
    reason = [accuracy] if isinstance(accuracy, str) and record.converged else []
    scene = draw_scene_picture(record, None if isinstance(accuracy, str) else accuracy)
    elements: list[Element] = [*scene, *reason]
    if all(isinstance(element, str) for element in elements):
        elements += _draw_home(record.robot if record.converged else record.initial)
    return Document(
        title=f"3-D view: {record.robot.name}",
        verdict=record.verdict.name.lower(),
        summary=summarize(record),
        made_by=describe_maker((record.result.get("made_by") or {}).get("versions", {})),
        sections=(Section("view", "The robot and its measured poses", tuple(elements)),),
    )


def _draw_home(robot: Mechanism) -> Iterator[Element]:
    """Yield a robot at home."""
    scene = Scene(robot)
    yield make_picture(
        draw_scene(scene),
        "scene-figure",
        "The robot at home.",
        "The picture shows limbs, joints, rods, platform and tool, in space and from above.",
        format_scene(scene),
    )
