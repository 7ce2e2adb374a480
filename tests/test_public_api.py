# SPDX-License-Identifier: Apache-2.0
"""The public names of the package: each exists, and importing the package imports none of what
stands behind them.
"""

import subprocess
import sys

import pytest

import loopcal


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
