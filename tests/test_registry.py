# SPDX-License-Identifier: Apache-2.0
"""Registries: entries are imported when they are looked up, and other packages add theirs."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

import loopcal as lc
from loopcal.errors import DataError
from loopcal.estimate.losses import LOSSES
from loopcal.estimate.methods import METHODS, RULES, SETTINGS
from loopcal.io.formats import FORMATS
from loopcal.measure.kinds import KINDS
from loopcal.mechanism.families import FAMILIES
from loopcal.registry import Registry, UnknownNameError, _list_entry_points


def test_entries_of_registries_have_the_names_of_their_keys() -> None:
    registries: Any = (KINDS, FORMATS, LOSSES, RULES)
    for registry in registries:
        assert [entry.name for entry in registry.values()] == list(registry)
    assert [family.family for family in FAMILIES.values()] == list(FAMILIES)
    methods: Any = METHODS
    assert [entry.name for name, entry in methods.items() if name != "auto"] == list(METHODS)[1:]
    assert {method for method, _ in SETTINGS.values()} < set(METHODS)
    assert len(FAMILIES) == len({*FAMILIES.values()})
    assert "pose" in KINDS
    assert "pose" in repr(KINDS)


@pytest.mark.parametrize("registry", [KINDS, FORMATS, LOSSES, METHODS, RULES, FAMILIES])
def test_an_unknown_name_is_refused_with_the_known_ones(registry) -> None:
    with pytest.raises(UnknownNameError, match="Known: " + ", ".join(registry)):
        registry["cauchy"]
    assert registry.get("cauchy") is None
    assert "cauchy" not in registry


def test_short_names_of_methods_are_accepted_but_not_listed() -> None:
    assert METHODS["ls"] is lc.LeastSquares
    assert METHODS.resolve("tsvd") == "truncated-svd"
    assert "ls" in METHODS
    assert "ls" not in list(METHODS)


def test_a_registry_imports_an_entry_when_it_is_looked_up() -> None:
    code = (
        "import sys; from loopcal.mechanism.families import FAMILIES; list(FAMILIES); "
        "'gough' in FAMILIES; "
        "name = 'loopcal.mechanism.families.gough'; before = name in sys.modules; "
        "FAMILIES['gough']; print(before, name in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False True\n"


def test_an_entry_replaces_one_of_a_user_but_none_of_loopcal() -> None:
    registry: Registry[Any] = Registry("thing", "", {"own": "math:pi"}, aliases={"o": "own"})
    first, second = SimpleNamespace(name="new"), SimpleNamespace(name="new")
    assert registry.register(first) is first
    registry.register(second)
    assert registry["new"] is second
    assert list(registry) == ["own", "new"]
    for name in ("own", "o"):
        with pytest.raises(DataError, match="name of a thing of loopcal"):
            registry.register(SimpleNamespace(name=name))
    with pytest.raises(DataError, match="has no name"):
        registry.register(object())


@pytest.fixture
def offer(monkeypatch):
    """A function that makes entry points those of all installed packages."""

    def replace(*points: EntryPoint) -> None:
        found = lambda group: [point for point in points if point.group == group]  # noqa: E731
        monkeypatch.setattr("importlib.metadata.entry_points", found)
        _list_entry_points.cache_clear()

    yield replace
    _list_entry_points.cache_clear()


def test_entry_points_of_other_packages_are_found_and_faulty_ones_refused(offer) -> None:
    offer(EntryPoint("e", "math:e", "things"), EntryPoint("gone", "no_such_package:x", "things"))
    registry: Registry[Any] = Registry("thing", "things", {"pi": "math:pi"})
    assert list(registry) == ["pi", "e", "gone"]
    assert 2.7 < registry["e"] < 2.8
    with pytest.raises(DataError, match="cannot load the thing 'gone' of no_such_package:x"):
        registry["gone"]


@dataclass(frozen=True)
class Unnamed:
    """A loss that is not registered."""

    def weight(self, distance, degrees):
        return 1.0 / (1.0 + distance)


@pytest.mark.parametrize(
    ("options", "plain"),
    [
        (lc.FitOptions(), {"method": "auto", "loss": "none"}),
        (
            lc.FitOptions(lc.LeastSquares(), lc.Tukey()),
            {"method": "least-squares", "loss": "tukey"},
        ),
        (lc.FitOptions(loss=lc.Huber(2.0)), {"loss": {"name": "huber", "k": 2.0}}),
        (lc.FitOptions(lc.Ridge(0.5)), {"method": {"name": "ridge", "lam": 0.5}}),
        (lc.FitOptions(lc.Ridge()), {"method": "ridge"}),
        (
            lc.FitOptions(lc.Ridge(lc.MarginalLikelihood())),
            {"method": {"name": "ridge", "lam": {"name": "marginal-likelihood"}}},
        ),
        (lc.FitOptions(lc.TruncatedSVD(7)), {"method": {"name": "truncated-svd", "k": 7}}),
        (lc.FitOptions(lc.MAP(2.0)), {"method": {"name": "map", "inflation": 2.0}}),
        (
            lc.FitOptions(lc.MAP(lc.InflatedTolerances("groups")), noise="estimated"),
            {"noise": "estimated"},
        ),
        (lc.FitOptions(control=lc.StepControl(iterations=3)), {"control": {"iterations": 3}}),
        (lc.FitOptions(start=[1.0, 2.0], excluded_poses=["6"]), {"start": [1.0, 2.0]}),
    ],
)
def test_options_are_plain_data_and_read_back(options, plain) -> None:
    written = options.to_dict()
    assert plain.items() <= written.items()
    assert repr(lc.FitOptions.from_dict(written)) == repr(options)


def test_settings_may_stand_beside_the_name_of_their_method() -> None:
    for plain, method in (
        ({"method": "ridge", "lam": 0.5}, lc.Ridge(0.5)),
        ({"method": "tsvd", "keep": 7}, lc.TruncatedSVD(7)),
        ({"method": {"name": "ridge"}, "lam": 0.5}, lc.Ridge(0.5)),
        ({"method": "auto", "inflation": "groups"}, lc.MAP(lc.InflatedTolerances("groups"))),
        ({"method": "auto", "inflation": "none"}, lc.MAP()),
        ({"method": "auto", "inflation": "auto"}, None),
    ):
        assert lc.FitOptions.from_dict(plain).method == method


@pytest.mark.parametrize(
    ("plain", "sentence"),
    [
        ({"loss": "cauchy"}, "'cauchy' is not a loss. Known: huber, tukey"),
        ({"method": "rigde"}, "not a method .*did you mean 'ridge'"),
        ({"method": {"lam": 1.0}}, "names no method"),
        ({"loss": {"name": "huber", "c": 2.0}}, "the loss huber has no setting 'c'; it has k"),
        ({"method": {"name": "ridge", "lam": {"name": "gcw"}}}, "not a rule"),
        ({"lost": "huber"}, "not an option of a fit .*'loss'"),
        ({"control": {"steps": 3}}, "'steps' is no limit of the steps"),
        (lc.FitOptions(loss=Unnamed()).to_dict(), r"Unnamed\(\) has no registered name"),
        (lc.FitOptions(lc.Ridge(lambda d: np.ones(1))).to_dict(), "has no registered name"),
    ],
)
def test_plain_options_that_do_not_fit_are_refused(plain, sentence) -> None:
    with pytest.raises(DataError, match=sentence):
        lc.FitOptions.from_dict(plain)


@dataclass(frozen=True)
class Doubled(lc.MAP):
    """A method of another package: twice the spreads."""

    name: ClassVar[str] = "doubled"
    inflation: Any = 2.0


@dataclass(frozen=True)
class KeepHalf:
    """A rule of another package: truncation keeps half of the directions."""

    name: ClassVar[str] = "half"

    def __call__(self, decomposition):
        return decomposition.rank // 2


def test_a_method_and_a_rule_of_another_package_are_used_by_their_names(offer) -> None:
    offer(
        EntryPoint("doubled", f"{__name__}:Doubled", "loopcal.methods"),
        EntryPoint("half", f"{__name__}:KeepHalf", "loopcal.rules"),
    )
    robot = lc.load_robot("linear-delta")
    poses = lc.sample_workspace(robot, 20, seed=1).coordinates
    sensor = lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 1e-5)))
    data = lc.simulate(robot, poses, lc.Instrument((sensor,)), seed=1)
    for plain, method in (
        ({"method": "doubled"}, lc.MAP(2.0)),
        ({"method": {"name": "truncated-svd", "k": {"name": "half"}}}, lc.TruncatedSVD(KeepHalf())),
    ):
        options = lc.FitOptions.from_dict(plain)
        assert options.to_dict()["method"] == plain["method"]
        named, built = (
            lc.identify(robot, data, options=o) for o in (options, lc.FitOptions(method))
        )
        assert named.estimate == pytest.approx(built.estimate, abs=0.0)


def test_every_place_that_is_named_in_a_string_exists(root) -> None:
    named = {
        place
        for path in (root / "src").rglob("*.py")
        for place in re.findall(r'"(loopcal(?:\.\w+)+:\w+)"', path.read_text("utf-8"))
    }
    assert len(named) > 30
    for place in sorted(named):
        module, _, name = place.partition(":")
        assert hasattr(import_module(module), name), place
