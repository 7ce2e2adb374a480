# SPDX-License-Identifier: Apache-2.0
"""The public names of the package: each exists, is documented, and is imported when first used."""

import ast
import inspect
import subprocess
import sys

import pytest

import loopcal
from tools import api_reference


@pytest.mark.parametrize("name", loopcal.__all__)
def test_every_public_name_exists(name) -> None:
    assert getattr(loopcal, name) is not None
    assert name in dir(loopcal)


def test_an_unknown_name_lists_the_public_ones() -> None:
    with pytest.raises(
        AttributeError, match=r"no attribute 'calibrate_all'; public names are .*identify"
    ):
        _ = loopcal.calibrate_all


def test_importing_the_package_imports_no_numpy() -> None:
    code = "import sys, loopcal; print('numpy' in sys.modules)"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )


def test_type_checkers_see_the_same_names() -> None:
    imports = [
        node
        for node in ast.walk(ast.parse(inspect.getsource(loopcal)))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("loopcal.")
    ]
    visible = {name.name: node.module for node in imports for name in node.names}
    assert visible == {
        name: package for package, names in loopcal.PUBLIC_NAMES.items() for name in names
    }


def test_the_page_of_the_api_is_up_to_date() -> None:
    assert api_reference.PAGE.read_text("utf-8") == api_reference.write_page(), "run `make docs`"
