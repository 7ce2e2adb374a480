# SPDX-License-Identifier: Apache-2.0
"""The engine under test, a fixture of every test in this folder: another engine is accepted by
adding it here.
"""

import importlib
from types import ModuleType

import pytest

from tests import zoo
from tests.engine.cases import Case, case


@pytest.fixture(scope="session", params=["loopcal.engine"])
def engine(request) -> ModuleType:
    return importlib.import_module(request.param)


@pytest.fixture(
    scope="session",
    params=["mixed_hexapod", "three_prs", "hexapod", "delta", "five_bar", "planar_rrr"],
)
def some(request) -> Case:
    """One mechanism after another: six, three and two freedoms, all endings, with and without
    passive joints.
    """
    return case(getattr(zoo, request.param)())
