# SPDX-License-Identifier: Apache-2.0
"""docs/hexapod-with-tracker.md: its commands run, and the files they write correct the machine."""

import re
import shutil
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.geometry import align_point_sets
from loopcal.typing import FloatArray
from tests.cli.page_commands import list_commands

pytestmark = pytest.mark.slow

PLACES = np.array([[0.15, 0.0, 0.0], [-0.08, 0.13, 0.0], [-0.08, -0.13, 0.0], [0.0, 0.0, 0.1]])
"""Points of the platform by which poses are compared [m]."""


@pytest.fixture(scope="module")
def outputs(root, tmp_path_factory) -> tuple[Path, str, dict[str, str]]:
    """Run the commands of the page; return the folder, the page and what each command printed."""
    page = (root / "docs" / "hexapod-with-tracker.md").read_text("utf-8")
    folder = tmp_path_factory.mktemp("hexapod") / "hexapod-tracker"
    shutil.copytree(root / "examples" / "hexapod-tracker", folder)
    printed: dict[str, str] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for words in list_commands(page):
            if words[0] == "example":  # the folder is a copy of it
                continue
            with redirect_stdout(StringIO()) as screen:
                assert main(words) == 0, words
            printed[" ".join(words)] = screen.getvalue()
    return folder, page, printed


def list_offsets(path: Path) -> FloatArray:
    """Return HOME_OFFSET of all joints [m]."""
    found = re.findall(r"^HOME_OFFSET = (\S+)$", path.read_text(), re.MULTILINE)
    return np.array([float(text) for text in found]) * 1e-3


def measure_error(controller: lc.Mechanism, truth: lc.Mechanism, added: FloatArray) -> float:
    """Return the error of points of the true platform [m], rms, after fits of base and platform.

    Parameters
    ----------
    controller : whose kinematics command the joint positions. added : (6,) to all HOME_OFFSET, so
        that a joint position is the reading of the robot file plus this.
    """
    commanded = lc.inverse(controller, lc.sample_workspace(truth, 200, seed=5).coordinates)
    reached = lc.forward(truth, commanded.q - added).T
    wanted, true = (T[:, None, :3, :3] @ PLACES[:, :, None] for T in (commanded.T, reached))
    a = wanted[..., 0] + commanded.T[:, None, :3, 3]
    b = true[..., 0] + reached[:, None, :3, 3]
    offset, fitted, moved = np.zeros((len(PLACES), 3)), b, a
    for _ in range(50):  # the base frame, and where each point is on the platform, in turn
        moved = a + (commanded.T[:, None, :3, :3] @ offset[:, :, None])[..., 0]
        F = align_point_sets(b.reshape(-1, 3), moved.reshape(-1, 3))
        fitted = b @ F[:3, :3].T + F[:3, 3]
        local = np.swapaxes(commanded.T[:, None, :3, :3], -1, -2) @ (fitted - a)[..., None]
        offset = local[..., 0].mean(axis=0)
    return float(np.sqrt(((fitted - moved) ** 2).sum(axis=2).mean()))


def test_commands_print_the_text_of_the_page(outputs) -> None:
    folder, page, printed = outputs
    blocks = re.findall(r"^```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 8
    written = [(folder / name).read_text() for name in ("start.csv", "poses.ngc")]
    for block in blocks:
        assert any(block in text for text in (*written, *printed.values())), block


def test_corrected_files_bring_the_true_machine_to_its_poses(loopcal, outputs) -> None:
    folder, page, _ = outputs
    robot, truth = lc.load_robot(folder / "hexapod.yaml"), lc.load_robot(folder / "truth.yaml")
    words = "import corrected.hal --unit mm --home-z 420mm -o controller.yaml"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        loopcal(words)
    controller = lc.load_robot(folder / "controller.yaml")
    added = list_offsets(folder / "corrected.ini") - list_offsets(folder / "machine.ini")
    before = measure_error(robot.with_values(robot.parameters.nominal), truth, np.zeros(6))
    after = measure_error(controller, truth, added)
    assert before > 0.1e-3
    predicted = np.hypot(6.93e-6, np.sqrt(2 / 3 * (PLACES**2).sum(1).mean()) * np.radians(2.16e-3))
    assert predicted == pytest.approx(8.2e-6, abs=0.1e-6)  # [m], of the page's two numbers
    assert after < 1.3 * predicted
    assert f"error of {after * 1e6:.2g} um" in " ".join(page.split())
    assert f"(before: {before * 1e3:.2g} mm)" in " ".join(page.split())
    only_centers = measure_error(controller, truth, np.zeros(6))
    assert only_centers > 3 * after  # offsets and centers belong together
