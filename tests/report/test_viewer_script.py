# SPDX-License-Identifier: Apache-2.0
"""The script of the 3-D view: made from the committed sources, licensed, self-contained."""

import hashlib
import re
import tomllib
from pathlib import Path

from loopcal.report.scene.scene import SCRIPT, load_script


def test_script_and_sources_have_the_recorded_hashes(root: Path) -> None:
    """`make viewer` writes SHA256SUMS; a source that changes alone fails here."""
    folder = root / "tools" / "viewer"
    lines = (folder / "SHA256SUMS").read_text("utf-8").splitlines()
    recorded = {(folder / name).resolve(): digest for digest, name in map(str.split, lines)}
    computed = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in recorded}
    assert computed == recorded
    assert {SCRIPT.resolve(), *folder.glob("src/*.js")} <= set(recorded)


def test_sources_state_their_license_and_the_script_that_of_three(root: Path) -> None:
    for path in (root / "tools" / "viewer").glob("src/*.js"):
        assert path.read_text("utf-8").startswith("// SPDX-License-Identifier: Apache-2.0\n")
    license_file = SCRIPT.with_name("three.LICENSE.txt")
    beginning = load_script()[:2000]
    assert "Permission is hereby granted" in license_file.read_text("utf-8")
    assert "three.js authors" in beginning
    assert "Permission is hereby granted" in beginning
    settings = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    assert "MIT" in settings["license"]
    assert license_file.relative_to(root).as_posix() in settings["license-files"]


def test_script_can_stand_inside_of_a_page_and_loads_nothing() -> None:
    script = load_script()
    assert script.isascii()
    assert re.search(r"</script|<!--", script, re.IGNORECASE) is None
    assert set(re.findall(r"https?://[\w./]+", script)) <= {"http://www.w3.org/1999/xhtml"}
    assert (
        re.search(r"\bfetch\(|XMLHttpRequest|importScripts|new Function|\beval\(", script) is None
    )
