# SPDX-License-Identifier: Apache-2.0
"""Special functions are those of scipy, and scipy.special stays complete."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
import scipy.special

from loopcal.numerics import special_functions

SOURCE = Path(special_functions.__file__)
NAMES = sorted(
    alias.name
    for node in ast.walk(ast.parse(SOURCE.read_text("utf-8")))
    if isinstance(node, ast.ImportFrom) and node.module == "scipy.special"
    for alias in node.names
)


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.parametrize("name", NAMES)
def test_function_is_that_of_scipy(name) -> None:
    assert getattr(special_functions, name) is getattr(scipy.special, name)


def test_imports_in_functions_look_nothing_up(monkeypatch) -> None:
    from loopcal.numerics.special_functions import ndtr

    monkeypatch.setattr(special_functions, "_import_functions", lambda: pytest.fail("looked up"))
    from loopcal.numerics.special_functions import ndtr as again

    assert again is ndtr


def test_functions_are_imported_without_the_package_and_are_those_of_a_later_import() -> None:
    code = f"""
import sys
from loopcal.numerics import special_functions
functions = [getattr(special_functions, name) for name in {NAMES}]
print("scipy.special" in sys.modules, "numpy.f2py" in sys.modules)
import scipy.special, scipy.stats
print(functions == [getattr(scipy.special, name) for name in {NAMES}])
print(scipy.special.erf(0.5), scipy.special.logsumexp([0.0]), scipy.stats.norm.cdf(0.0))
"""
    assert run(code).splitlines() == ["False False", "True", "0.5204998778130465 0.0 0.5"]


def test_public_names_of_scipy_are_complete_after_a_first_import_of_the_functions() -> None:
    show = "import scipy.special; print(*sorted(n for n in dir(scipy.special) if n[0] != '_'))"
    first = "from loopcal.numerics.special_functions import ndtri; "
    assert run(first + show) == run(show)


def test_the_package_is_imported_where_another_thread_runs() -> None:
    code = """
import sys, threading
from loopcal.numerics import special_functions
end = threading.Event()
other = threading.Thread(target=end.wait)
other.start()
special_functions.ndtri
print("scipy.special" in sys.modules)
end.set()
"""
    assert run(code) == "True"


def test_the_package_is_imported_where_the_functions_have_no_module_of_their_own() -> None:
    code = """
import sys
from loopcal.numerics import special_functions
special_functions.COMPILED = "scipy.special.no_such_module"
print(special_functions.ndtri(0.5), "scipy.special" in sys.modules)
"""
    assert run(code) == "0.0 True"


def test_a_name_that_scipy_does_not_have_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_function"):
        getattr(special_functions, NAMES[0] + "_no_function")
