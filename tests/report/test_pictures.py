# SPDX-License-Identifier: Apache-2.0
"""Pictures show names as they are written, and are identical for identical robots."""

import xml.etree.ElementTree as ET

import pytest
from matplotlib.text import Text

from loopcal.io.core.text_file import write_bytes
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.robot.robot_file import build_robot, find_robot_file
from loopcal.report.pictures import FORMATS, save_figure
from loopcal.report.scene.scene import draw_robot

NAMES = ["$\\frac{", "$x$", "<b>&amp;>", "100 % {0}"]


def build(name: str):
    text = find_robot_file("five-bar").read_text("utf-8").replace("five-bar", f"'{name}'")
    return build_robot(parse_yaml(text.replace("name: west", f"name: '{name}'"), "r.yaml", "robot"))


@pytest.mark.parametrize("name", NAMES)
def test_names_are_shown_as_they_are_written(name, tmp_path) -> None:
    robot = build(name)
    figure = draw_robot(robot)
    texts = [artist for artist in figure.findobj(Text) if isinstance(artist, Text)]
    assert [text for text in texts if name in text.get_text() and not text.get_parse_math()]
    figure.canvas.draw()
    save_figure(tmp_path / "a.svg", draw_robot(robot), write=write_bytes)
    ET.parse(tmp_path / "a.svg")


@pytest.mark.parametrize("ending", FORMATS)
def test_picture_has_the_same_bytes_each_time(ending, tmp_path, monkeypatch) -> None:
    robot = build("five-bar")
    for i, moment in enumerate(("1", "86400000")):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", moment)
        save_figure(tmp_path / f"{i}{ending}", draw_robot(robot), write=write_bytes)
    assert (tmp_path / f"0{ending}").read_bytes() == (tmp_path / f"1{ending}").read_bytes()
