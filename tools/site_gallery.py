# SPDX-License-Identifier: Apache-2.0
"""Pictures of the gallery: figures of loopcal belong to no window, so pyplot does not list them."""

from typing import Any


def scrape_figures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save each new figure that a block of an example has drawn, and return its markup.

    A figure is the value of the last expression of the block, or of a variable.
    """
    from matplotlib.figure import Figure
    from sphinx_gallery.scrapers import figure_rst

    del block
    names = block_vars["example_globals"]
    saved = names.setdefault("__saved_figures__", [])
    figures = [value for value in list(names.values()) if isinstance(value, Figure)]
    paths = []
    for figure in figures:
        if any(figure is other for other in saved):
            continue
        saved.append(figure)
        paths.append(next(block_vars["image_path_iterator"]))
        figure.savefig(paths[-1], dpi=130, bbox_inches="tight")
    return figure_rst(paths, gallery_conf["src_dir"]) if paths else ""
