# SPDX-License-Identifier: Apache-2.0
"""One engine computes in a process: the one that LOOPCAL_ENGINE names, and results state it."""

import importlib.util
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint, version

import numpy as np
import pytest

from loopcal import engine
from loopcal.cli.entry_point import main
from loopcal.engine import Engine, select_engine, selection
from loopcal.errors import MissingPackageError
from tests.engine.conftest import HAS_NATIVE


@pytest.fixture
def environment(monkeypatch):
    """Set LOOPCAL_ENGINE, as in a new process; the engine is chosen anew afterwards."""

    def name(choice):
        monkeypatch.setenv(selection.VARIABLE, choice)
        selection.get_current_engine.cache_clear()

    yield name
    selection.get_current_engine.cache_clear()


def make_counting_engine(variant: str) -> Engine:
    """Return the NumPy engine under another name, as an entry point would."""
    if variant == "old":
        return Engine("counting:old", "0.9", lambda: None)  # pyright: ignore
    if variant == "none":
        return None  # pyright: ignore
    if variant == "failing":
        return variant.no_such_attribute  # pyright: ignore
    if variant not in ("", "fast"):
        raise ValueError(f"no variant {variant!r}")
    return replace(
        select_engine("numpy"),
        name=f"counting:{variant}",
        version="1.0",
        fold=lambda factor, rows: factor + len(rows),
    )


@pytest.fixture
def installed(monkeypatch):
    """Install an engine named `counting`, and one whose package is broken."""
    values = {"counting": f"{__name__}:make_counting_engine", "broken": "no_such_module:make"}
    points = [EntryPoint(name, value, selection.GROUP) for name, value in values.items()]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: points)
    monkeypatch.setattr(EntryPoint, "load", load)


def load(point: EntryPoint):
    """Load an entry point of these tests, whose module pytest imported under another name."""
    if point.name == "broken":
        raise ImportError("it was built for another processor")
    return make_counting_engine


def test_numpy_computes_where_nothing_else_is_installed(monkeypatch):
    monkeypatch.setattr(selection, "find_spec", lambda _: None)
    assert str(select_engine()) == f"numpy {np.__version__}"


def test_a_folder_with_the_name_of_the_native_engine_is_no_engine(monkeypatch, tmp_path):
    (tmp_path / "loopcal_native").mkdir()
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, "loopcal_native", raising=False)
    assert importlib.util.find_spec("loopcal_native") is not None
    assert select_engine().name == "numpy"


def test_the_environment_names_the_engine_of_all_callers(environment, installed):
    environment("counting:fast")
    assert str(engine.get_current_engine()) == "counting:fast 1.0"
    assert engine.fold(np.zeros((1, 2, 2)), np.zeros((1, 3, 2))).max() == 1.0
    environment("numpy")
    assert engine.fold(np.zeros((1, 2, 2)), np.zeros((1, 3, 2))).max() == 0.0


@pytest.mark.parametrize(
    ("choice", "code"),
    [
        ("nativ", "engine.unknown"),
        ("numpy:v2", "engine.unknown"),
        (":v2", "engine.unknown"),
        ("broken", "engine.not-usable"),
        ("counting:slow", "engine.not-usable"),
        ("counting:old", "engine.not-usable"),
        ("counting:none", "engine.not-usable"),
        ("counting:failing", "engine.not-usable"),
    ],
)
def test_engines_that_cannot_compute_are_refused_in_a_sentence(installed, choice, code):
    with pytest.raises(MissingPackageError) as refusal:
        select_engine(choice)
    assert refusal.value.code == code
    assert repr(choice) in str(refusal.value)


def test_a_wrong_name_ends_a_command_with_a_sentence(environment, capsys, tmp_path):
    """The sentence names no file: the variable is wrong, not what was read."""
    environment("nativ")
    (tmp_path / "study.yaml").write_text(
        "format: 1\ntitle: x\nseed: 1\nrobots: [five-bar]\n", "utf-8"
    )
    for words in (["check", "five-bar"], ["study", "check", str(tmp_path / "study.yaml")]):
        assert main(words) == 1
        assert capsys.readouterr().err.startswith("loopcal: The engine 'nativ' is not installed")


def test_version_states_the_engine(environment, capsys):
    environment("numpy")
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == f"engine numpy {np.__version__}"


def test_provenance_states_the_engine(environment):
    environment("numpy")
    assert engine.collect_versions()["engine"] == f"numpy {np.__version__}"


@pytest.mark.skipif(not HAS_NATIVE, reason="loopcal-native is not installed")
def test_the_native_engine_states_the_version_of_its_package():
    assert select_engine("native").version == version("loopcal-native")
