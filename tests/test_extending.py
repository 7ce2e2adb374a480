# SPDX-License-Identifier: Apache-2.0
"""docs/extending.md: a package with a kind, a loss and a format of its own."""

import json
import re
import runpy
import shlex
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError
from loopcal.estimate.losses import LOSSES
from loopcal.io.formats import FORMATS
from loopcal.measure.kinds import KINDS
from loopcal.registry import _list_entry_points
from loopcal.typing import FloatArray

MODE = re.MULTILINE | re.DOTALL
PAGE = Path(__file__).parents[1] / "docs" / "extending.md"


def find_block(language: str) -> str:
    """Return the block of the page in a language."""
    (block,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE.read_text(), MODE)
    return block


def run_module(folder: Path) -> dict:
    """Return the names of the module of the page, after it was executed as in a notebook."""
    (folder / "notebook.py").write_text(find_block("python"))
    return runpy.run_path(str(folder / "notebook.py"))


@pytest.fixture
def registered(monkeypatch):
    """Forget what a test registers."""
    for registry in (LOSSES, KINDS, FORMATS):
        monkeypatch.setattr(registry, "_registered", {})
    monkeypatch.delitem(sys.modules, "acme", raising=False)
    _list_entry_points.cache_clear()
    yield
    _list_entry_points.cache_clear()


@pytest.fixture
def package(registered, tmp_path, monkeypatch) -> Path:
    """An installed package with the module of the page, without its calls of `register`."""
    text = re.sub(r"^@lc\.register_\w+\n", "", find_block("python"), flags=re.MULTILINE)
    text = text.replace("lc.register_format(\n    lc.Format", "(\n    lc.Format")
    assert "register" not in text
    site = tmp_path / "site"
    (site / "acme-1.dist-info").mkdir(parents=True)
    (site / "acme.py").write_text(text)
    (site / "acme-1.dist-info" / "METADATA").write_text("Name: acme\nVersion: 1\n")
    points = tomllib.loads(find_block("toml"))["project"]["entry-points"]
    lines = [
        line
        for group, entries in points.items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()))
    ]
    (site / "acme-1.dist-info" / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(str(site))
    return tmp_path


@pytest.mark.slow
def test_the_commands_of_the_page_use_an_installed_package(package, monkeypatch, capsys) -> None:
    monkeypatch.chdir(package)
    Path("printer.acme").write_text("RADIUS 105\nARM 220\n")
    for name, text in re.findall(
        r"<!-- file: (\S+) -->\n```yaml\n(.*?)^```$", PAGE.read_text(), MODE
    ):
        Path(name).write_text(text)
    for line in find_block("sh").splitlines():
        words = shlex.split(line)
        assert main(words[1:]) == 0, (line, capsys.readouterr())
    assert "runout" in Path("data.csv").read_text()
    cells = json.loads(Path("results/summary.json").read_text())["cells"]
    assert {cell["levels"]["instrument"] for cell in cells} == {"both", "tracker"}
    assert len(cells) == 4
    result = json.loads(Path("run/result.json").read_text())
    assert result["options"]["fit"]["loss"] == "cauchy"
    radius, _ = Path("calibrated.acme").read_text().split()[1::2]
    assert float(radius) == pytest.approx(1e3 * lc.load_run("run").robot.values[0], abs=1e-6)
    capsys.readouterr()
    assert main(["calibrate", "--help"]) == 0
    assert "[none|huber|tukey|cauchy]" in capsys.readouterr().out


def test_the_module_of_the_page_registers_itself(registered, tmp_path, capsys) -> None:
    names = run_module(tmp_path)
    robot = lc.load_robot("linear-delta")
    truth = robot.with_values(lc.sample_truth(robot, 1, seed=1)[0])
    sensors = (
        lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 1e-5))),
        lc.Sensor(names["Runout"](), lc.Gaussian(np.full(1, 1e-5))),
    )
    poses = lc.sample_workspace(robot, 20, seed=1).coordinates
    data = lc.simulate(truth, poses, lc.Instrument(sensors), seed=1)
    options = lc.FitOptions(loss=names["Cauchy"](3.0))
    fit = lc.identify(robot, data, options=options)
    assert fit.converged
    assert options.to_dict()["loss"] == {"name": "cauchy", "c": 3.0}
    assert lc.FitOptions.from_dict(options.to_dict()).loss == names["Cauchy"](3.0)
    assert "runout" in lc.KINDS
    assert main(["export", "linear-delta", "--format", "acme"]) == 0
    assert capsys.readouterr().out == "RADIUS 105.000000\nARM 220.000000\n"


def test_the_kind_of_the_page_has_the_derivatives_of_its_columns(registered, tmp_path) -> None:
    names = run_module(tmp_path)
    kind = names["Runout"]()
    x, step = np.array([[[0.03, -0.02, 0.5]]]), 1e-6
    _, slope, _ = kind.predict(x, np.zeros((1, 0)))
    for axis in range(3):
        move = np.eye(3)[axis] * step
        high, low = (kind.predict(x + sign * move, np.zeros((1, 0)))[0] for sign in (1, -1))
        assert slope[0, 0, 0, axis] == pytest.approx((high - low).item() / (2 * step), abs=1e-8)


def test_a_setting_has_the_dimension_that_it_declares(registered, tmp_path) -> None:
    kind = run_module(tmp_path)["Runout"]
    annotations = {"lean": Annotated[float, lc.Dimension.ANGLE], "name": ClassVar[str]}
    tilted = type(
        "Tilted", (kind,), {"__annotations__": annotations, "lean": 0.0, "name": "tilted"}
    )
    lc.register_kind(dataclass(frozen=True, eq=False, kw_only=True)(tilted))
    made: Any = KINDS["tilted"]
    robot, path = lc.load_robot("hexapod-42"), tmp_path / "data.csv"
    sensor = lc.Sensor(made(lean=np.pi / 6), lc.Gaussian(np.array([1e-6])))
    poses = lc.sample_workspace(robot, 3, seed=1).coordinates
    data = lc.simulate(robot, poses, lc.Instrument((sensor,)), seed=1)
    lc.save_measurements(data, path, robot)
    assert "# lean: 30 deg\n" in path.read_text()
    (rows,) = lc.load_measurements(path, robot).observations
    assert vars(rows.kind)["lean"] == pytest.approx(np.pi / 6, rel=1e-15)
    path.write_text(path.read_text().replace("30 deg", "30 mm"))
    with pytest.raises(FileError, match="lean"):
        lc.load_measurements(path, robot)


def test_settings_of_every_simple_type_are_written_and_read(registered, tmp_path) -> None:
    settings: dict[str, tuple[Any, Any, str]] = {
        "flag": (bool, True, "true"),
        "count": (int, 3, "3"),
        "depth": (float, 0.012, "12 mm"),
        "lean": (Annotated[float, lc.Dimension.ANGLE], np.pi / 6, "30 deg"),
        "gain": (Annotated[float, lc.Dimension.RATIO], 1.25, "1.25"),
        "steps": (tuple[float, ...], (0.001, 0.002), "[1 mm, 2 mm]"),
        "turns": (tuple[int, ...], (1, 2), "[1, 2]"),
        "shown": (Literal["near", "far"], "far", "far"),
        "words": (tuple[str, ...], ("a", "b"), "[a, b]"),
        "limit": (float | None, 0.5, "500 mm"),
        "place": (np.ndarray, np.array([1, 0, 2]), "[1000 mm, 0 mm, 2000 mm]"),
    }
    annotations = {key: of for key, (of, _, _) in settings.items()} | {"name": ClassVar[str]}
    annotations["place"] = FloatArray
    bases = (run_module(tmp_path)["Runout"],)
    made = type(
        "Rich", bases, {"__annotations__": annotations, "name": "rich", **dict.fromkeys(settings)}
    )
    lc.register_kind(dataclass(frozen=True, eq=False, kw_only=True)(made))
    kind: Any = KINDS["rich"]
    robot, path = lc.load_robot("hexapod-42"), tmp_path / "data.csv"
    sensor = lc.Sensor(
        kind(**{k: value for k, (_, value, _) in settings.items()}), lc.Gaussian(np.array([1e-6]))
    )
    poses = lc.sample_workspace(robot, 3, seed=1).coordinates
    lc.save_measurements(lc.simulate(robot, poses, lc.Instrument((sensor,)), seed=1), path, robot)
    written = path.read_text()
    (rows,) = lc.load_measurements(path, robot).observations
    for key, (_, value, text) in settings.items():
        assert f"# {key}: {text}\n" in written
        read = getattr(rows.kind, key)
        assert type(read) is type(value)
        assert np.array_equal(read, value), key
    for key, wrong, fact in (
        ("flag", "7", "the number 7, but must be true or false"),
        ("count", "2.5", "the number 2.5, but must be a whole number"),
        ("steps", "[3]", "'3' has no unit"),
        ("shown", "left", "left.* Allowed: 'near', 'far'"),
    ):
        path.write_text(written.replace(f"{key}: {settings[key][2]}", f"{key}: {wrong}"))
        with pytest.raises(FileError, match=f"'{key}.*{fact}"):
            lc.load_measurements(path, robot)


def test_what_is_no_kind_and_no_loss_cannot_be_registered(registered) -> None:
    with pytest.raises(DataError, match="extends Kind"):
        lc.register_kind(int)
    with pytest.raises(DataError, match="lacks the function 'weight"):
        lc.register_loss(int)
    with pytest.raises(DataError, match="'huber' is the name of a loss of loopcal"):
        lc.register_loss(lc.Huber)
    with pytest.raises(DataError, match="'json' is the name of a format"):
        lc.register_format(lc.Format("json", "another one"))
