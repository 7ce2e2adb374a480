# SPDX-License-Identifier: Apache-2.0
"""Settings and fixtures of all tests: one BLAS thread, 64-bit jax, reproducible hypothesis,
reference data.

Under LOOPCAL_STRICT=1 a skipped test is a failure, so that no test is left out unnoticed.
"""

import gc
import os
import signal
from collections.abc import Generator
from pathlib import Path
from types import ModuleType

import pytest

# Small matrices only: more threads cost more than they bring. Set before numpy is imported for the
# first time.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# each derivative is compiled for one point: optimizing it takes longer than running it
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

from hypothesis import HealthCheck, settings  # noqa: E402

gc.disable()  # what collection makes stays: `pytest_collection_finish`

# A shell starts what runs in the background with Ctrl-C ignored, and its children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run; no deadline, because machines differ.
settings.register_profile(
    "loopcal",
    max_examples=40,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("loopcal")

ROOT = Path(__file__).resolve().parent.parent
STRICT = os.environ.get("LOOPCAL_STRICT") == "1"


def pytest_report_header() -> str:
    """Return the line that says which engine computes in the tests."""
    from loopcal.engine import get_current_engine

    return f"engine: {get_current_engine()}"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the tests that fork first: copying a process takes longer the more it holds."""
    items.sort(key=lambda item: item.get_closest_marker("forks") is None)


def pytest_collection_finish() -> None:
    """Leave modules and collected tests out of all searches for garbage."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def root() -> Path:
    """Return the folder of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Return the folder of measured data and reference numbers that are not part of the project."""
    folder = Path(os.environ.get("LOOPCAL_DATA") or ROOT.parent / "shared" / "data")
    folder = folder if folder.is_absolute() else ROOT / folder
    if not folder.is_dir():
        pytest.skip(f"no reference data in {folder}: set LOOPCAL_DATA to its folder")
    return folder


def leave_out_drawing(patch: pytest.MonkeyPatch) -> None:
    """Leave out the layout and the drawing of figures: it takes a third of the time of a plan and
    nine tenths of that of a report, and tests/report draws every figure.
    """

    def save(_, out, **_options) -> None:
        if isinstance(out, str | Path):
            Path(out).write_bytes(b"\x89PNG\r\n\x1a\n")
        else:
            out.write(b"\x89PNG\r\n\x1a\n")

    patch.setattr("matplotlib.figure.Figure.savefig", save)
    patch.setattr("matplotlib.figure.Figure.draw_without_rendering", lambda _: None)
    empty = b'<svg xmlns="http://www.w3.org/2000/svg" width="400pt" viewBox="0 0 400 300"></svg>'
    patch.setattr("loopcal.report.pictures._render_svg", lambda _: empty)


@pytest.fixture
def do_not_draw(monkeypatch) -> None:
    """Write placeholders for pictures in one test."""
    leave_out_drawing(monkeypatch)


@pytest.fixture(scope="session")
def jax() -> ModuleType:
    """Return jax set to 64 bits, for derivatives that are independent of ours."""
    import jax

    jax.config.update("jax_enable_x64", True)
    return jax


def _refuse_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Turn a skip into a failure under LOOPCAL_STRICT=1; an expected failure (xfail) stays what it
    is.
    """
    if STRICT and report.outcome == "skipped" and not hasattr(report, "wasxfail"):
        reason = report.longrepr[-1] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"LOOPCAL_STRICT=1 allows no skip: {reason}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Apply `_refuse_skip` to each test."""
    report = yield
    _refuse_skip(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Apply `_refuse_skip` to modules that skip themselves as a whole."""
    report = yield
    _refuse_skip(report)
    return report
