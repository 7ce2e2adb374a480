# SPDX-License-Identifier: Apache-2.0
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# Classes are looked up by name.
"""Every public result is shown in notebooks, and gives tables of pandas and xarray."""

import builtins
import dataclasses
import importlib
import inspect
import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.results.result import Result, TableResult

NAMES = """
    CalibrationOptions Column Constraints FitOptions GCV Gaussian Huber InflatedTolerances
    Instrument LeastSquares LineOfSight MAP MarginalLikelihood PlanOptions Prior Ridge Sensor
    StatedValue StepControl SurfaceOptions TruncatedSVD TruncationGCV Tukey Uniform Dask Processes
    Ray Serial Autocollimation Bearing Closure Component Direction Distance Inclination JointSensor
    Line Locked Plane Pose Position Separation Sphere Observations Trials InstrumentRecord
    Exported Format Imported TargetKind Volume
"""
SETTINGS = frozenset(NAMES.split())
"""Public classes that a user passes in, which are no results."""


class Reader(HTMLParser):
    """Collects tags, and checks that they are nested."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag, attrs) -> None:
        self.open.append(tag)
        self.tags.add(tag)

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag


def check_html(result: Any) -> str:
    text = result._repr_html_()
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    assert reader.tags <= {"div", "style", "pre", "table", "caption", "thead", "tbody"} | {
        "tr",
        "th",
        "td",
    }
    for table in text.split("<table>")[1:]:
        assert table.count("<tr>") <= 31
    return text


def list_result_classes() -> list[type]:
    classes = [getattr(lc, name) for name in lc.__all__ if inspect.isclass(getattr(lc, name))]
    return [
        c
        for c in classes
        if dataclasses.is_dataclass(c)
        and c.__name__ not in SETTINGS
        and not issubclass(c, Exception)
    ]


@pytest.mark.parametrize("result_class", list_result_classes(), ids=lambda c: c.__name__)
def test_every_public_result_has_a_page_for_notebooks(result_class) -> None:
    advice = "give it a base class of loopcal.results.result, or list it in SETTINGS above"
    assert callable(getattr(result_class, "_repr_html_", None)), advice


def list_returned_classes() -> set[type]:
    """Return the classes of loopcal that public functions return."""
    functions = [getattr(lc, name) for name in lc.__all__ if inspect.isfunction(getattr(lc, name))]
    modules = [inspect.getmodule(inspect.unwrap(function)) for function in functions]
    returned = set()
    for function, module in zip(functions, modules, strict=True):
        for name in re.findall(r"[A-Z]\w+", str(inspect.signature(function).return_annotation)):
            value = getattr(module, name, None)
            if inspect.isclass(value) and value.__module__.startswith("loopcal."):
                returned.add(value)
    return returned


@pytest.mark.parametrize(
    "result_class",
    sorted(list_returned_classes(), key=lambda c: c.__name__),
    ids=lambda c: c.__name__,
)
def test_what_public_functions_return_has_a_page_for_notebooks(result_class) -> None:
    assert result_class.__name__ in SETTINGS or issubclass(result_class, Result)


@pytest.fixture(scope="module")
def results(five_bar, plan, root, tmp_path_factory) -> dict[str, Any]:
    """One result of each class, by its name."""
    fit, data, held_out = five_bar.fit, five_bar.fitted, five_bar.held_out
    robot, report = five_bar.robot, lc.calibrate(five_bar.robot, data)
    boot = lc.bootstrap(fit, data, 20, seed=1)
    sample = lc.sample_posterior(fit, data, 200, seed=1)
    folder = tmp_path_factory.mktemp("runs") / "run"
    lc.save_run(report, folder)
    made: list[Any] = [
        fit,
        report,
        boot,
        sample,
        lc.load_run(folder),
        boot.intervals(),
        lc.validate(fit, held_out),
        lc.accuracy_map(fit, data.readings, poses=40),
        lc.pose_uncertainty(fit, lc.forward(robot, data.readings)),
        lc.compensate(fit, lc.forward(robot, data.readings).T[:3]),
        lc.identifiability(robot, data),
        lc.check_conventions(robot, data),
        lc.examine_fit(fit, data),
        lc.find_outliers(fit, data),
        lc.cross_validate(robot, data, count=3),
        lc.choose_model(robot, data, count=3),
        lc.compute_regularization_curves(robot, data, folds=3),
        lc.compare_with_truth(fit, robot.values),
        lc.compute_joint_region(fit, list(fit.names[:2])),
        lc.compute_simultaneous_intervals(fit),
        lc.forward(robot, data.readings),
        lc.jacobian(robot, data.readings),
        data,
        robot,
        plan,
        lc.load_study(min((root / "examples" / "studies").glob("*.yaml")), quick=True),
        lc.trace_singularity(robot, readings=data.readings[:2]),
        lc.sample_workspace(robot, 4),
        lc.find_assembly_modes(robot, data.readings[0]),
        lc.judge_estimate(1e-5, 2e-6, 1.5e-5),
        report.findings[0],
    ]
    return {type(result).__name__: result for result in made}


def test_pages_are_short_and_valid_html(results) -> None:
    for result in results.values():
        text = check_html(result)
        assert text.startswith('<div class="loopcal">')


def test_frames_and_datasets_of_every_result_state_units(results) -> None:
    tables = [result for result in results.values() if isinstance(result, TableResult)]
    assert len(tables) >= 20
    for result in tables:
        frame, data = result.to_frame(), result.to_dataset()
        assert len(frame) > 0, type(result)
        assert not frame.columns.duplicated().any()
        has_unit_column = "unit" in frame.columns
        for name, values in frame.items():
            is_number = values.dtype.kind == "f"
            assert not is_number or "[" in name or has_unit_column, (type(result), name)
        for name, values in data.items():
            is_number = values.dtype.kind == "f"
            has_units = "units" in values.attrs or "unit" in data
            assert not is_number or has_units, (type(result), name)


def test_frame_of_a_fit_has_the_numbers_of_the_fit(five_bar) -> None:
    fit = five_bar.fit
    frame = fit.to_frame().set_index("parameter")
    assert list(frame.index) == list(fit.names)
    assert frame.loc["west.motor.x", "unit"] == "mm"
    assert_allclose(frame.loc["west.motor.x", "estimate"], 1e3 * fit.estimate[0])
    data = fit.to_dataset()
    assert_allclose(data["residual_1_position"].values, fit.residuals[0].raw)
    assert list(data["row_1"].values) == list(fit.residuals[0].poses)
    assert_allclose(np.sqrt(np.diag(data["covariance"])), frame["sd"])
    assert_allclose(data["sum_of_squares"], fit.history.cost)


def test_frame_of_a_validation_has_one_row_for_each_error(results) -> None:
    validation = results["Validation"]
    frame = validation.to_frame()
    assert list(frame["pose"]) == list(validation.poses)
    assert_allclose(frame["after"], validation.after["position"].size)
    assert set(frame["unit"]) == {"m"}


def test_frame_of_measurements_has_every_number(five_bar) -> None:
    frame = five_bar.fitted.to_frame()
    (rows,) = five_bar.fitted.observations
    assert_allclose(frame["value"].to_numpy().reshape(rows.measured.shape), rows.measured)
    assert list(frame["component"][:3]) == ["x", "y", "z"]
    assert_allclose(five_bar.fitted.to_dataset()["reading"], five_bar.fitted.readings)


def test_frame_of_a_plan_has_the_commands_in_order(plan) -> None:
    frame = plan.to_frame()
    assert_allclose(frame[["commanded x [m]", "commanded y [m]", "commanded z [m]"]],
                    plan.poses.coordinates)  # fmt: skip
    assert set(frame["use"]) == {"fit", "held-out"}


def test_long_tables_say_how_many_rows_are_left_out(hexapod) -> None:
    text = check_html(hexapod.fit)
    assert "and 12 more rows" in text
    assert "leg1.base.x" in text


def test_names_in_pages_are_text(five_bar) -> None:
    name = "<script>alert(1)</script>\x1b[31m"
    robot = replace(five_bar.robot, assembly=replace(five_bar.robot.assembly, name=name))
    for result in (robot, replace(five_bar.fit, robot=robot)):
        text = check_html(result)
        assert "<script" not in text
        assert "\x1b" not in text
        assert "&lt;script&gt;" in text


@pytest.mark.parametrize(("method", "package"), [("to_frame", "pandas"), ("to_dataset", "xarray")])
def test_missing_package_is_named_with_the_command_that_installs_it(
    method, package, five_bar, monkeypatch
) -> None:
    real = importlib.import_module

    def refuse(name, *arguments):
        if name == package:
            raise ImportError(name)
        return real(name, *arguments)

    monkeypatch.setattr("loopcal.environment.import_module", refuse)
    with pytest.raises(lc.MissingPackageError, match=re.escape("pip install 'loopcal[tables]'")):
        getattr(five_bar.fit, method)()
    with pytest.raises(builtins.ImportError):
        getattr(five_bar.fit, method)()


@pytest.mark.slow
def test_results_draw_themselves(results, five_bar) -> None:
    fit = five_bar.fit
    figures = [getattr(fit.plot, name)() for name in ("residuals", "parameters")]
    figures += [getattr(fit.plot, name)() for name in ("correlation", "convergence")]
    figures += [results[name].plot() for name in ("Validation", "AccuracyMap", "Identifiability")]
    figures += [results["Plan"].plot(), five_bar.robot.plot()]
    assert all(isinstance(figure, Figure) for figure in figures)
    assert "residuals()" in repr(fit.plot)


def test_only_results_with_numbers_have_tables(results) -> None:
    for result in results.values():
        assert isinstance(result, Result | lc.Finding)
        assert hasattr(result, "to_frame") == isinstance(result, TableResult)
