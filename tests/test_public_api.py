# SPDX-License-Identifier: Apache-2.0
"""Public names of the package: each exists, is documented, and is imported on first use."""

import subprocess
import sys

import pytest

import loopcal
from tools import api_reference


@pytest.mark.parametrize("name", loopcal.__all__)
def test_every_public_name_exists(name) -> None:
    assert getattr(loopcal, name) is not None
    assert name in dir(loopcal)


def test_unknown_attribute_is_named() -> None:
    with pytest.raises(AttributeError, match="calibrate_all"):
        _ = getattr(loopcal, "calibrate_all")  # noqa: B009


def test_importing_loopcal_does_not_import_numpy() -> None:
    code = "import sys, loopcal; print('numpy' in sys.modules)"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )


def test_api_page_is_up_to_date() -> None:
    assert api_reference.PAGE.read_text("utf-8") == api_reference.write_page(), "run `make docs`"
