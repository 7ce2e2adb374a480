# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the shipped robots, docs/pictures/robots, and those of the building blocks
in docs/robots.md, docs/pictures/blocks.

python -m tools.robot_pictures           all of them
python -m tools.robot_pictures tricept   these only
"""

import argparse
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import loopcal as lc
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.report.scene.scene import draw_robot

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "pictures"
PAGE = ROOT / "docs" / "robots.md"


def read_blocks() -> dict[str, str]:
    """Return the robot files of the section of building blocks, by the names of the robots."""
    section = PAGE.read_text("utf-8").partition("\n## Building blocks\n")[2]
    files = re.findall(r"```yaml\n(.*?)```", section, flags=re.DOTALL)
    return {re.findall(r"^name: (.*)$", text, flags=re.MULTILINE)[0]: text for text in files}


def load_robots() -> dict[Path, lc.Mechanism]:
    """Return every robot that has a picture, by the file of its picture."""
    robots = {PICTURES / "robots" / f"{n}.png": lc.load_robot(n) for n in list_shipped_robots()}
    with TemporaryDirectory() as folder:
        for name, text in read_blocks().items():
            path = Path(folder) / f"{name}.yaml"
            path.write_text(text, "utf-8")
            robots[PICTURES / "blocks" / f"{name}.png"] = lc.load_robot(path)
    return robots


def main() -> int:
    """Draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="names of robots; all by default")
    wanted = parser.parse_args().robots
    for path, robot in load_robots().items():
        if not wanted or path.stem in wanted:
            path.parent.mkdir(parents=True, exist_ok=True)
            draw_robot(robot).savefig(path, dpi=70, metadata={"Software": None})
    return 0


if __name__ == "__main__":
    sys.exit(main())
