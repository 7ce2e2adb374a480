# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the engine tests: the engine under test (add another engine here), and example
mechanisms.
"""

import importlib
from types import ModuleType

import pytest

from tests import zoo
from tests.engine.cases import Case, make_case


@pytest.fixture(scope="session", params=["loopcal.engine"])
def engine(request) -> ModuleType:
    return importlib.import_module(request.param)


@pytest.fixture(
    scope="session",
    params=["mixed_hexapod", "three_prs", "hexapod", "delta", "five_bar", "planar_rrr"],
)
def case(request) -> Case:
    """Mechanisms of six, three and two freedoms, all endings, with and without passive joints."""
    return make_case(getattr(zoo, request.param)())
