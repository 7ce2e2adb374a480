# SPDX-License-Identifier: Apache-2.0
"""Renderings of scenes by the script of the 3-D view, in Chromium: what a reader of a report sees,
as a picture.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from loopcal.documents import find_browser, is_root
from loopcal.errors import LoopcalError
from loopcal.report.scene.scene import Scene, format_scene, load_script

PAGE = """<!doctype html><meta charset="utf-8"><style>
body {{ margin: 0; font: {font}px "DejaVu Sans", sans-serif; }} figure {{ margin: 0; }}
.place {{ position: relative; overflow: hidden; }} canvas {{ display: block; outline: none; }}
.names span {{ position: absolute; left: 5px; top: -.7em; text-shadow: 0 0 3px #fff; }}
.names {{ display: {names}; }} .controls, .legend, .viewer p {{ display: none; }}
</style><figure class="scene"><script type="application/json">{scene}</script></figure>
<script>{script}</script>"""

ARGUMENTS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Of Chromium, so that it draws without a graphics card."""

PLAIN, GREY = ("limb", "rod", "cable", "rod drive", "joint", "slide"), "#5f6b78"
"""Roles that are grey beside the one color of errors."""

SELECT = "list => { list.value = '0'; list.dispatchEvent(new Event('change')); }"
"""Shows the first motion of a scene."""


class Renderer:
    """A browser that draws scenes."""

    def __init__(self, browser: Any) -> None:
        self.browser = browser

    def __call__(
        self,
        scene: Scene,
        width: int,
        *,
        keys: str = "",
        names: bool = True,
        font: int = 13,
        color: str = "",
        has_map: bool = False,
    ) -> Any:
        """Return a scene as a picture of Pillow of twice this width [CSS px].

        keys : pressed in turn, such as `ArrowLeft ArrowLeft +`, to rotate and zoom the view.
        color : of errors, and of the second robot, which is shown if the scene has motions.
        has_map : whether the uncertainty over the workspace is shown.
        """
        from PIL import Image

        data = json.loads(format_scene(scene))
        if color:
            data["poses"]["colors"]["error"] = color
            for part in data["parts"]:
                if part["role"] in PLAIN:
                    part["color"] = GREY
        page = self.browser.new_page(
            viewport={"width": width, "height": 800}, device_scale_factor=2
        )
        page.set_content(
            PAGE.format(
                font=font,
                names="block" if names else "none",
                scene=json.dumps(data).replace("<", "\\u003c"),
                script=load_script(),
            )
        )
        page.locator("canvas").wait_for()
        if scene.motions:
            page.get_by_label("Second robot").evaluate(SELECT)
        if has_map:
            page.get_by_label("uncertainty over").evaluate("box => box.click()")
        page.locator("canvas").focus()
        for key in keys.split():
            page.keyboard.press(key)
        page.wait_for_timeout(400)  # until the screen shows it
        picture = page.locator(".place").screenshot(type="png")
        page.close()
        return Image.open(BytesIO(picture)).convert("RGB")


@contextmanager
def open_renderer() -> Iterator[Renderer]:
    """Open a browser that draws scenes, and close it at the end."""
    from playwright.sync_api import sync_playwright

    path = find_browser()
    if path is None:
        raise LoopcalError("renderings need Chromium, and it is not installed; install it")
    arguments = [*ARGUMENTS, *(("--no-sandbox",) if is_root() else ())]
    with sync_playwright() as program:
        browser = program.chromium.launch(executable_path=path, args=arguments)
        yield Renderer(browser)
        browser.close()


def save_picture(path: Path, figure: Figure, dpi: float) -> None:
    """Write a figure as a PNG file of 256 colors, which is a third of the size."""
    from PIL import Image

    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    path.parent.mkdir(parents=True, exist_ok=True)
    few = Image.open(stream).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
