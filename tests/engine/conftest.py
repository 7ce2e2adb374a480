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
collect_ignore = [] if HAS_NATIVE else ["native"]


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
