# SPDX-License-Identifier: Apache-2.0
"""Pictures of robots: shipped robots, drawn positions, units on the axes, file formats."""

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import FileError
from loopcal.io.core.text_file import write_bytes
from loopcal.io.robot.robot_file import load_robot
from loopcal.report.pictures import save_figure
from loopcal.report.scene.scene import draw_robot, list_parts
from tests import zoo


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.FEW_ROBOTS)
def test_picture_of_every_shipped_robot_has_units_on_its_axes(name):
    robot = load_robot(name)
    figure = draw_robot(robot)
    above = figure.axes[-1]
    for axes in figure.axes:
        assert "[mm]" in axes.get_xlabel()
        assert "[mm]" in axes.get_ylabel()
    assert robot.name in figure.get_suptitle()
    count = len(robot.assembly.limbs)
    assert f" {count} {'limb' if count == 1 else 'limbs'}, " in figure.get_suptitle()
    assert {text.get_text() for text in above.texts} == {limb.name for limb in robot.assembly.limbs}


def test_rods_are_drawn_from_base_to_platform_in_millimeters():
    robot = zoo.hexapod()
    above = draw_robot(robot).axes[1]
    lines = [np.array(line.get_data()).T for line in above.lines]
    for base, top in zip(zoo.HEXAPOD_BASE, zoo.HEXAPOD_PLATFORM, strict=True):
        assert any(
            line.shape == (2, 2) and np.allclose(line, [base[:2], top[:2]], atol=1e-6)
            for line in lines
        )


def test_check_with_plot_writes_the_picture(tmp_path, capsys):
    assert main(["check", "five-bar", "--plot", str(tmp_path / "five-bar.png")]) == 0
    assert (tmp_path / "five-bar.png").read_bytes().startswith(b"\x89PNG")
    assert "Picture:" in capsys.readouterr().out


def test_unknown_picture_format_is_refused(tmp_path):
    with pytest.raises(
        FileError, match=r"picture as '.docx'. Use a name that ends in .png, .svg, .pdf"
    ):
        save_figure(tmp_path / "robot.docx", draw_robot(zoo.hexapod()), write=write_bytes)


def test_a_machine_in_an_upright_plane_is_shown_from_the_side():
    axes = draw_robot(load_robot("excavator")).axes[1]
    assert axes.get_title() == "from the side"
    assert axes.get_ylabel() == "z [mm]"
    assert draw_robot(zoo.hexapod()).axes[1].get_title() == "from above"


def test_universal_joint_between_two_bodies_is_drawn_as_one_point():
    robot = load_robot("biped-leg")
    (line,) = (p for p in list_parts(robot, robot.home_state) if p.role == "limb" and p.index == 2)
    assert robot.assembly.limbs[2].name == "ankle"
    assert np.ptp(line.points, axis=1).max() < 1e-12  # [m] was an arc of 84 mm about the joint


def test_links_of_a_spherical_machine_are_arcs_about_its_center():
    above = draw_robot(load_robot("agile-eye")).axes[1]
    limbs = [np.array(line.get_data()).T for line in above.lines][:3]
    for line in limbs:
        assert len(line) == 26  # two arcs
        assert 190.0 < np.linalg.norm(line, axis=1).max() < 301.0  # [mm] radii of a 1 m machine
