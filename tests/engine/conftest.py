# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the engine tests: the engine under test (add another engine here), and example
mechanisms.
"""

from importlib.util import find_spec

import pytest

from loopcal.engine import Engine, select_engine
from tests import zoo
from tests.engine.cases import Case, make_case

HAS_NATIVE = find_spec("loopcal_native") is not None
ENGINES = ["numpy", "native"] if HAS_NATIVE else ["numpy"]
OPTIONAL = ["test_certify.py", "test_compare_poses.py", "test_triangles.py"]
"""Tests of functions that an engine need not have; NumPy leaves them to other packages."""
collect_ignore = [] if HAS_NATIVE else ["native", *OPTIONAL]


def list_engines_with(function: str) -> list[Engine]:
    """Return the installed engines that have an optional function."""
    engines = [select_engine(name) for name in ENGINES]
    return [engine for engine in engines if getattr(engine, function) is not None]


@pytest.fixture(scope="session", params=ENGINES)
def engine(request) -> Engine:
    return select_engine(request.param)


@pytest.fixture(
    scope="session",
    params=["mixed_hexapod", "three_prs", "hexapod", "delta", "five_bar", "planar_rrr"],
)
def case(request) -> Case:
    """Mechanisms of six, three and two freedoms, all endings, with and without passive joints."""
    return make_case(getattr(zoo, request.param)())
