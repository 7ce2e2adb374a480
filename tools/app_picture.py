# SPDX-License-Identifier: Apache-2.0
"""Draw docs/pictures/app.png: the page of `loopcal app` after the calibration of the example.

python -m tools.app_picture
"""

import subprocess
import sys
from io import BytesIO
from pathlib import Path

from tools.rendering import open_renderer

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "pictures" / "app.png"
DATA = ROOT / "examples" / "hexapod-42" / "measurements.csv"
SIZE, LAST_ROWS = {"width": 860, "height": 900}, 6


def main() -> int:
    """Draw the picture."""
    from PIL import Image

    command = [sys.executable, "-m", "loopcal", "app", "--no-browser"]
    with (
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server,
        open_renderer() as render,
    ):
        assert server.stderr is not None
        page = render.browser.new_page(viewport=SIZE)
        page.goto(server.stderr.readline().split()[2])
        page.set_input_files("#choose", DATA)
        page.wait_for_selector("#list li")
        page.select_option("#robot", "hexapod-42")
        page.wait_for_timeout(500)  # until the server has both
        page.click("#calibrate:enabled")
        page.wait_for_selector("#reports:not([hidden])", timeout=120_000)
        page.wait_for_selector("#progress", state="hidden")
        page.wait_for_timeout(1000)  # until the rows are drawn
        last = page.locator("#tables tbody tr").nth(LAST_ROWS).bounding_box()
        clip = {"x": 0, "y": 0, "width": SIZE["width"], "height": last["y"] + last["height"]}
        picture = page.screenshot(full_page=True, clip=clip)
        page.close()
        server.terminate()
    few = Image.open(BytesIO(picture)).convert("RGB").quantize(64, dither=Image.Dither.NONE)
    few.save(PICTURE, optimize=True)
    print(f"wrote {PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size / 1024:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
