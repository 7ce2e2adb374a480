# SPDX-License-Identifier: Apache-2.0
"""Which text and which tables show a result in a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from itertools import groupby
from typing import Any

import numpy as np

from loopcal.apply.accuracy import COMPONENTS, AccuracyMap, AccuracySimulation, PoseUncertainty
from loopcal.apply.calibration_report import CalibrationReport
from loopcal.apply.compensation import Compensation
from loopcal.apply.conformity import Conformity
from loopcal.apply.error_budget import ErrorBudget
from loopcal.apply.height_errors import HeightErrors
from loopcal.apply.repeatability import DIMENSIONS, Repeatability
from loopcal.apply.run_comparison import RunComparison
from loopcal.apply.validation import Validation
from loopcal.diagnose.bootstrap import Bootstrap
from loopcal.diagnose.cross_validation import CrossValidation, ModelChoice
from loopcal.diagnose.fit_examination import FitExamination
from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.diagnose.intervals import Intervals
from loopcal.diagnose.joint_regions import JointRegion, SimultaneousIntervals
from loopcal.diagnose.outliers import OutlierCheck
from loopcal.diagnose.posterior_sample import PosteriorSample
from loopcal.diagnose.regularization_curves import RegularizationCurves
from loopcal.diagnose.value_comparison import ValueComparison
from loopcal.environment import import_optional
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.nuisance_estimate import NuisanceEstimate
from loopcal.estimate.recalibration import Change
from loopcal.estimate.result import Identification, KindResiduals
from loopcal.estimate.trial_identification import IdentifiedTrials
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.mechanism.solutions import Jacobian, Solution
from loopcal.mechanism.states import Status
from loopcal.plain_text import escape
from loopcal.planning.plane_line_planning import SurfacePlan
from loopcal.planning.result import Plan
from loopcal.presentation import TableResult
from loopcal.report.calibration_view import (
    build_model_table,
    name_source,
    view_calibration,
    view_compensation,
    view_fit,
    view_heights,
)
from loopcal.report.tables import Block, Column, Table, format_number
from loopcal.report.validation_view import (
    find_error_units,
    find_shift,
    view_bootstrap,
    view_comparison,
    view_posterior,
    view_regularization,
    view_repeatability,
    view_validation,
)
from loopcal.units import SI_SYMBOLS

# --- Paragraphs and tables as HTML for notebooks.

MOST_ROWS = 30
"""Rows of a table that a notebook shows."""

STYLE = (
    "<style>.loopcal pre{white-space:pre-wrap;margin:0.3em 0}"
    ".loopcal caption{text-align:left;font-weight:bold}"
    ".loopcal th,.loopcal td{padding:0 0.5em}"
    ".loopcal .words{text-align:left}.loopcal .numbers{text-align:right}</style>"
)
"""Left for words, right for numbers; colors are those of the notebook."""


def render_html(blocks: Iterable[Block]) -> str:
    """Return a page as one `<div>`; of tables the first `MOST_ROWS` rows.

    Names are shown as they are written: markup and control characters have no effect.
    """
    sections = []
    for is_table, group in groupby(blocks, lambda block: isinstance(block, Table)):
        if is_table:
            sections += [_render_table(table) for table in group if isinstance(table, Table)]
        elif text := "\n".join(str(block) for block in group).strip("\n"):
            sections.append(f"<pre>{html.escape(text)}</pre>")
    return escape(f'<div class="loopcal">{STYLE}{"".join(sections)}</div>', "\n")


def _render_table(table: Table) -> str:
    """Return the first rows of a table, and how many more there are."""
    more = len(table.rows) - MOST_ROWS
    if more <= 0:
        return table.to_html()
    shown = replace(table, rows=table.rows[:MOST_ROWS]).to_html()
    return f"{shown}<pre>and {more} more {'row' if more == 1 else 'rows'}</pre>"


# --- The numbers of a result by name, with units and dimensions: for tables of every sort.

OTHER = "other"
"""Second dimension of a matrix over the rows of the main table, such as a covariance."""


@dataclass(frozen=True, eq=False)
class Variable:
    """An array with named dimensions.

    Attributes
    ----------
    name : of the array. dimensions : of its axes. values : the array.
    unit : its symbol, or one for each entry along the last axis; empty for words.
    """

    name: str
    dimensions: tuple[str, ...]
    values: Any
    unit: str | tuple[str, ...] = ""


@dataclass(frozen=True, eq=False)
class Records:
    """The arrays of a result.

    Attributes
    ----------
    variables : the arrays. labels : dimension -> names along it; numbers from 1 for others.
    main : dimension of the rows of the main table. Variables along it are columns of that table, an
        array with a second dimension has a column for each label of it, but a matrix (second
        dimension `OTHER`) has none.
    """

    main: str
    variables: tuple[Variable, ...]
    labels: Mapping[str, Sequence[Any]]

    def list_columns(self) -> dict[str, np.ndarray]:
        """Return heading -> values of the main table, beginning with the labels of its rows."""
        columns = {self.main: np.asarray(self.labels[self.main])}
        for variable in self.variables:
            values = np.asarray(variable.values)
            if variable.dimensions == (self.main,):
                columns[_add_unit(variable.name, variable.unit)] = values
            elif variable.dimensions[:-1] == (self.main,) and variable.dimensions[1] != OTHER:
                names = self.labels[variable.dimensions[1]]
                for i, name in enumerate(names):
                    unit = variable.unit if isinstance(variable.unit, str) else variable.unit[i]
                    columns[_add_unit(f"{variable.name} {name}".strip(), unit)] = values[:, i]
        return columns


def _add_unit(name: str, unit: str | tuple[str, ...]) -> str:
    """Return the heading of a column."""
    return f"{name} [{unit}]" if unit and isinstance(unit, str) else name


def number_from_one(count: int) -> list[int]:
    """Return labels of entries without names."""
    return list(range(1, count + 1))


@singledispatch
def collect_records(result: object) -> Records:
    """Return the numbers of a result."""
    raise TypeError(f"{type(result).__name__} has no records")


# --- The numbers of fits, of what they determine, and of their uncertainty.

PARAMETER, DRAW = "parameter", "draw"


def _list_si_units(free: FreeParameters) -> tuple[str, ...]:
    """Return the SI symbols of free parameters."""
    return tuple(SI_SYMBOLS[parameter.dimension] for parameter in free.parameters)


@collect_records.register
def collect_fit(result: Identification) -> Records:
    """Return parameters in the units of the robot's file, covariance, correlation and residuals."""
    rows = result.to_dict()["parameters"]
    keys = ("nominal", "estimate", "sd", "plus_minus", "degrees", "tolerance")
    columns = [Variable(key, (PARAMETER,), np.array([row[key] for row in rows])) for key in keys]
    units = Variable("unit", (PARAMETER,), np.array([row["unit"] for row in rows]))
    factor, _ = result.free_parameters.display()
    covariance = result.covariance / np.outer(factor, factor)
    matrix = Variable("covariance", (PARAMETER, OTHER), covariance, "unit times unit of other")
    labels: dict[str, Sequence[Any]] = {PARAMETER: result.names, OTHER: result.names}
    residuals = []
    for i, rows_of_kind in enumerate(result.residuals, 1):
        residuals += _collect_residuals(rows_of_kind, i, labels)
    history = result.history
    labels["step"] = list(range(len(history.cost)))
    cost = Variable("sum_of_squares", ("step",), history.cost, "1")
    return Records(PARAMETER, (units, *columns, matrix, *residuals, cost), labels)


def _collect_residuals(
    rows: KindResiduals, number: int, labels: dict[str, Sequence[Any]]
) -> list[Variable]:
    """Return residuals of one kind (predicted - measured), and the labels of their poses."""
    row, component = f"row_{number}", f"component_{number}"
    labels[row], labels[component] = rows.poses, rows.components
    units = tuple(SI_SYMBOLS[dimension] for dimension in rows.dimensions)
    return [
        Variable(f"residual_{number}_{rows.kind}", (row, component), rows.raw, units),
        Variable(f"whitened_{number}_{rows.kind}", (row, component), rows.whitened, "sigma"),
    ]


@collect_records.register
def collect_report(result: CalibrationReport) -> Records:
    """Return the numbers of the fit."""
    return collect_records(result.identification)


@collect_records.register
def collect_trials(result: IdentifiedTrials) -> Records:
    """Return the estimates of each trial [SI]."""
    free = result.free_parameters
    return Records(
        "trial",
        (
            Variable("converged", ("trial",), result.converged),
            Variable("iterations", ("trial",), result.iterations, "1"),
            Variable("sum_of_squares", ("trial",), result.cost, "1"),
            Variable(
                "estimate",
                ("trial", PARAMETER),
                result.values[:, free.places],
                _list_si_units(free),
            ),
        ),
        {"trial": number_from_one(len(result.values)), PARAMETER: free.names},
    )


@collect_records.register
def collect_identifiability(result: Identifiability) -> Records:
    """Return what is determined of each parameter, and the singular values."""
    names = result.free_parameters.names
    direction = number_from_one(len(result.singular_values))
    s = Variable("singular_value", ("direction",), result.singular_values, "sigma per tolerance")
    return Records(
        PARAMETER,
        (
            Variable("determined", (PARAMETER,), np.array([p.state for p in result.parameters])),
            Variable("sd_over_tolerance", (PARAMETER,), [p.left for p in result.parameters], "1"),
            s,
        ),
        {PARAMETER: names, "direction": direction},
    )


@collect_records.register
def collect_cross_validation(result: CrossValidation) -> Records:
    """Return the held-out score of each fold."""
    fold = ("fold",)
    return Records(
        "fold",
        (
            Variable("mean_square_before", fold, result.before_fold, "sigma^2"),
            Variable("mean_square", fold, result.fold, "sigma^2"),
        ),
        {"fold": number_from_one(len(result.fold))},
    )


@collect_records.register
def collect_model_choice(result: ModelChoice) -> Records:
    """Return the scores of the parameter sets."""
    sets, of_set = result.candidates, ("set",)
    return Records(
        "set",
        (
            Variable("parameters", of_set, [len(c.parameters) for c in sets], "1"),
            Variable("rank", of_set, [c.conditioning.rank for c in sets], "1"),
            Variable("condition", of_set, [float(c.conditioning.condition) for c in sets], "1"),
            Variable("score", of_set, [float(c.score) for c in sets], "sigma^2"),
            Variable("standard_error", of_set, [float(c.standard_error) for c in sets], "sigma^2"),
            Variable("chosen", of_set, [c is result.chosen for c in sets]),
        ),
        {"set": [c.name for c in sets]},
    )


@collect_records.register
def collect_outliers(result: OutlierCheck) -> Records:
    """Return whether each block of poses fits the others."""
    names, suspects = result.names, result.suspects
    states = [
        "outlier"
        if set(poses) <= set(names)
        else "contradicts others"
        if set(poses) <= set(suspects)
        else "fits"
        for poses in result.poses
    ]
    labels = [", ".join(poses) for poses in result.poses]
    return Records("poses", (Variable("state", ("poses",), np.array(states)),), {"poses": labels})


@collect_records.register
def collect_curves(result: RegularizationCurves) -> Records:
    """Return the points of both curves."""
    curves = (result.ridge, result.truncation)
    count = sum(len(curve.values) for curve in curves)
    arrays = {
        name: np.concatenate([getattr(curve, name) for curve in curves])
        for name in ("values", "score", "standard_error")
    }
    method = np.repeat([curve.name for curve in curves], [len(curve.values) for curve in curves])
    point = ("point",)
    return Records(
        "point",
        (
            Variable("regularization", point, method),
            Variable("value", point, arrays["values"], "1"),
            Variable("score", point, arrays["score"], "sigma^2"),
            Variable("standard_error", point, arrays["standard_error"], "sigma^2"),
        ),
        {"point": number_from_one(count)},
    )


@collect_records.register
def collect_comparison(result: ValueComparison) -> Records:
    """Return the differences between the estimate and given values."""
    of_parameter = (PARAMETER,)
    return Records(
        PARAMETER,
        (
            Variable("estimate_minus_given", of_parameter, result.raw, "SI"),
            Variable("determined_part", of_parameter, result.error, "SI"),
            Variable("determined_part_in_tolerances", of_parameter, result.tolerances, "tolerance"),
        ),
        {PARAMETER: result.names},
    )


@collect_records.register
def collect_intervals(result: Intervals) -> Records:
    """Return intervals [SI]."""
    names = ("center", "sd", "lower", "upper", "linear_lower", "linear_upper")
    arrays = [Variable(name, (PARAMETER,), getattr(result, name), "SI") for name in names]
    off = Variable("linear_is_off", (PARAMETER,), result.is_off)
    return Records(PARAMETER, (*arrays, off), {PARAMETER: result.names})


@collect_records.register
def collect_simultaneous(result: SimultaneousIntervals) -> Records:
    """Return intervals [SI] that hold together, and those that hold one at a time."""
    names = ("center", "half_widths", "single")
    arrays = [Variable(name, ("quantity",), getattr(result, name), "SI") for name in names]
    return Records("quantity", tuple(arrays), {"quantity": result.names})


@collect_records.register
def collect_region(result: JointRegion) -> Records:
    """Return center, half-widths and covariance [SI] of a joint region."""
    names = ("center", "standard_deviations", "half_widths")
    arrays = [Variable(name, ("quantity",), getattr(result, name), "SI") for name in names]
    matrix = Variable("covariance", ("quantity", OTHER), result.covariance, "SI times SI")
    labels = {"quantity": result.names, OTHER: result.names}
    return Records("quantity", (*arrays, matrix), labels)


@collect_records.register
def collect_bootstrap(result: Bootstrap) -> Records:
    """Return the estimates of each resample [SI]."""
    return _collect_draws(result.fit, result.draws, ())


@collect_records.register
def collect_sample(result: PosteriorSample) -> Records:
    """Return the draws [SI] with their weights."""
    weight = Variable("weight", (DRAW,), result.weight, "1")
    return _collect_draws(result.fit, result.draws, (weight,))


def _collect_draws(
    fit: Identification, draws: np.ndarray, weights: tuple[Variable, ...]
) -> Records:
    """Return draws of the parameters of a fit."""
    units = _list_si_units(fit.free_parameters)
    values = Variable("estimate", (DRAW, PARAMETER), draws, units)
    labels = {DRAW: number_from_one(len(draws)), PARAMETER: fit.names}
    return Records(DRAW, (*weights, values), labels)


# --- The numbers of robots and of measurements.

MACHINE_PARAMETER = "parameter"


@collect_records.register
def collect_robot(result: Mechanism) -> Records:
    """Return the parameters in the units of the robot's file."""
    table = result.parameters
    units = [result.get_unit(parameter.dimension) for parameter in table.entries]
    factor = np.array([unit.factor_to_si for unit in units])
    of_parameter = (MACHINE_PARAMETER,)
    return Records(
        MACHINE_PARAMETER,
        (
            Variable("value", of_parameter, result.values / factor),
            Variable("nominal", of_parameter, table.nominal / factor),
            Variable("tolerance", of_parameter, table.tolerance / factor),
            Variable("unit", of_parameter, np.array([unit.symbol for unit in units], str)),
            Variable("free", of_parameter, np.asarray(table.free, bool)),
        ),
        {MACHINE_PARAMETER: table.names},
    )


@collect_records.register
def collect_measurements(result: Measurements) -> Records:
    """Return one row for each measured number [SI], and the readings of the poses.

    The noise is the standard deviation of the residual of this number, where each column has one.
    """
    words: dict[str, list[str]] = {"kind": [], "pose": [], "component": [], "unit": []}
    values: list[float] = []
    for rows in result.observations:
        members = rows.rows.reshape(len(rows), -1)
        labels = ["/".join(result.labels[i] for i in row) for row in members]
        columns = rows.kind.columns
        words["kind"] += [rows.kind.name] * (len(rows) * len(columns))
        words["pose"] += [label for label in labels for _ in columns]
        words["component"] += [column.name for column in columns] * len(rows)
        words["unit"] += [SI_SYMBOLS[column.dimension] for column in columns] * len(rows)
        values += rows.measured.ravel().tolist()
    row = ("number",)
    readings = result.readings
    return Records(
        "number",
        (
            *(Variable(name, row, np.array(cells, str)) for name, cells in words.items()),
            Variable("value", row, np.array(values, float)),
            Variable("reading", ("measured_pose", "actuator"), readings, "m or rad"),
            Variable("held_out", ("measured_pose",), result.is_held_out),
        ),
        {
            "number": number_from_one(len(values)),
            "measured_pose": result.labels,
            "actuator": number_from_one(readings.shape[1]),
        },
    )


# --- The numbers of poses: errors, uncertainty, plans, compensation, solutions.

POSE, COMPONENT, COORDINATE, ACTUATOR = "pose", "component", "coordinate", "actuator"
TWIST_UNITS = ("rad", "rad", "rad", "m", "m", "m")
"""Units of a small rotation and a displacement."""


def _collect_coordinates(name: str, names: tuple[str, ...], values: Any) -> Variable:
    """Return controlled coordinates (n, c) [SI]."""
    units = tuple("m" if coordinate in POSITION else "rad" for coordinate in names)
    return Variable(name, (POSE, COORDINATE), values, units)


def _collect_readings(robot: Mechanism, values: Any) -> Variable:
    """Return actuator readings (n, a) [SI]."""
    units = tuple(SI_SYMBOLS[actuator.dimension] for actuator in robot.actuators)
    return Variable("reading", (POSE, ACTUATOR), values, units)


def _name_actuators(robot: Mechanism) -> tuple[str, ...]:
    return tuple(actuator.name for actuator in robot.actuators)


@collect_records.register
def collect_validation(result: Validation) -> Records:
    """Return the sizes of the errors before and after of each quantity, row and target [SI]."""
    poses, targets, quantities, units = [], [], [], []
    sizes: dict[str, list[float]] = {"before": [], "after": []}
    for quantity in result.quantities:
        after = result.after[quantity]
        poses += [result.poses[i] for i in after.rows]
        targets += list(after.targets)
        quantities += [quantity] * len(after.rows)
        units += [SI_SYMBOLS[after.dimension]] * len(after.rows)
        for name, errors in (("before", result.before), ("after", result.after)):
            sizes[name] += errors[quantity].size.tolist()
    row = ("row",)
    words = {"pose": poses, "target": targets, "quantity": quantities, "unit": units}
    return Records(
        "row",
        (
            *(Variable(name, row, np.array(values, str)) for name, values in words.items()),
            *(Variable(name, row, np.array(values, float)) for name, values in sizes.items()),
        ),
        {"row": number_from_one(len(poses))},
    )


@collect_records.register
def collect_heights(result: HeightErrors) -> Records:
    """Return places and errors of heights [SI]."""
    row = ("row",)
    return Records(
        "row",
        (
            Variable("pose", row, np.array(result.poses, str)),
            Variable("x", row, result.points[:, 0], "m"),
            Variable("y", row, result.points[:, 1], "m"),
            Variable("before", row, result.before, "m"),
            Variable("after", row, result.after, "m"),
            Variable("held_out", row, result.is_held_out),
        ),
        {"row": number_from_one(len(result.poses))},
    )


def _collect_uncertainty(result: PoseUncertainty) -> tuple[Variable, ...]:
    """Return uncertainties of poses [rad, m]."""
    return (
        Variable("position", (POSE,), result.position, "m"),
        Variable("orientation", (POSE,), result.orientation, "rad"),
        Variable("sd", (POSE, COMPONENT), result.sd, TWIST_UNITS),
        Variable("expanded", (POSE, COMPONENT), result.expanded, TWIST_UNITS),
    )


@collect_records.register
def collect_uncertainty(result: PoseUncertainty) -> Records:
    """Return standard and expanded uncertainties of poses."""
    labels = {POSE: number_from_one(len(result.T)), COMPONENT: COMPONENTS}
    return Records(POSE, _collect_uncertainty(result), labels)


@collect_records.register
def collect_map(result: AccuracyMap) -> Records:
    """Return coordinates with their uncertainty."""
    labels = {
        POSE: number_from_one(len(result.coordinates)),
        COMPONENT: COMPONENTS,
        COORDINATE: result.names,
    }
    coordinates = _collect_coordinates("commanded", result.names, result.coordinates)
    extrapolated = Variable("extrapolated", (POSE,), result.extrapolated)
    return Records(
        POSE, (coordinates, extrapolated, *_collect_uncertainty(result.uncertainty)), labels
    )


@collect_records.register
def collect_simulation(result: AccuracySimulation) -> Records:
    """Return predicted and observed errors."""
    shape = (POSE, COMPONENT)
    return Records(
        POSE,
        (
            Variable("predicted", shape, result.predicted.sd, TWIST_UNITS),
            Variable("observed", shape, result.observed, TWIST_UNITS),
            Variable("ratio", shape, result.ratio, "1"),
        ),
        {POSE: number_from_one(len(result.observed)), COMPONENT: COMPONENTS},
    )


@collect_records.register
def collect_compensation(result: Compensation) -> Records:
    """Return what to set or command at each target, and the errors before and after."""
    variables = [
        Variable("status", (POSE,), np.array([reach.value for reach in result.reach])),
        _collect_readings(result.robot, result.readings),
        Variable("before", (POSE, COMPONENT), result.before, TWIST_UNITS),
        Variable("remaining", (POSE, COMPONENT), result.remaining, TWIST_UNITS),
    ]
    names = result.robot.controlled
    if result.commands is not None:
        variables.insert(1, _collect_coordinates("command", names, result.commands))
    labels = {POSE: result.labels, ACTUATOR: _name_actuators(result.robot)}
    return Records(POSE, tuple(variables), {**labels, COORDINATE: names, COMPONENT: COMPONENTS})


@collect_records.register(Plan)
@collect_records.register(SurfacePlan)
def collect_plan(result: Plan | SurfacePlan) -> Records:
    """Return the poses in their order."""
    poses, robot = result.poses, result.robot
    use = np.where(poses.held_out, "held-out", "fit")
    return Records(
        POSE,
        (
            Variable("use", (POSE,), use),
            _collect_coordinates("commanded", robot.controlled, poses.coordinates),
            _collect_readings(robot, poses.readings),
        ),
        {POSE: poses.labels, COORDINATE: robot.controlled, ACTUATOR: _name_actuators(robot)},
    )


@collect_records.register
def collect_solution(result: Solution) -> Records:
    """Return status, position of the platform, readings and passive joints [SI]."""
    status = [Status(int(value)).name.lower().replace("_", " ") for value in result.status]
    reading, passive = number_from_one(result.q.shape[1]), result.passive_names
    return Records(
        POSE,
        (
            Variable("status", (POSE,), np.array(status)),
            Variable("platform", (POSE, "axis"), result.T[:, :3, 3], "m"),
            Variable("reading", (POSE, ACTUATOR), result.q, "m or rad"),
            Variable("residual", (POSE,), result.residual, "m"),
            Variable("passive", (POSE, "joint"), result.passive, "m or rad"),
            Variable("T_base_platform", (POSE, "row", "column"), result.T, "m"),
        ),
        {
            POSE: number_from_one(len(result)),
            "axis": POSITION,
            ACTUATOR: reading,
            "joint": passive,
            "row": number_from_one(4),
            "column": number_from_one(4),
        },
    )


@collect_records.register
def collect_jacobian(result: Jacobian) -> Records:
    """Return the derivatives of each component of each pose by parameters and readings [SI]."""
    n, components = len(result.parameters), result.components
    by_parameter = result.parameters.reshape(-1, len(result.parameter_names))
    by_reading = result.readings.reshape(-1, len(result.reading_names))
    of_row = ("row",)
    return Records(
        "row",
        (
            Variable("pose", of_row, np.repeat(number_from_one(n), len(components))),
            Variable("component", of_row, np.array(list(components) * n, str)),
            Variable("unit", of_row, np.array(TWIST_UNITS * n, str)),
            Variable(
                "by",
                ("row", "parameter"),
                by_parameter,
                tuple(f"unit per {unit}" for unit in result.parameter_units),
            ),
            Variable(
                "by_reading",
                ("row", ACTUATOR),
                by_reading,
                tuple(f"unit per {unit}" for unit in result.reading_units),
            ),
        ),
        {
            "row": number_from_one(n * len(components)),
            "parameter": result.parameter_names,
            ACTUATOR: result.reading_names,
        },
    )


# --- The numbers of setup parameters, repeatability, uncertainty budgets and compared runs.

RESULT_PARAMETER, SOURCE, ROW = "parameter", "source", "row"


@collect_records.register
def collect_nuisance(result: NuisanceEstimate) -> Records:
    """Return setup parameters in the units in which they are shown."""
    factor = np.array([factor for factor, _ in result.display])
    nominal = np.array([entry.nominal for entry in result.table.entries])
    columns = {"nominal": nominal, "estimate": result.estimate, "sd": result.sd}
    units = np.array([symbol for _, symbol in result.display], dtype=str)
    return Records(
        RESULT_PARAMETER,
        (
            Variable("unit", (RESULT_PARAMETER,), units),
            *(
                Variable(name, (RESULT_PARAMETER,), values / factor)
                for name, values in columns.items()
            ),
        ),
        {RESULT_PARAMETER: result.names},
    )


@collect_records.register
def collect_repeatability(result: Repeatability) -> Records:
    """Return AP and RP with their intervals, one row for each pose and component [SI]."""
    words: dict[str, list[str]] = {}
    numbers: dict[str, list[float]] = {}
    for quantity, poses in result.poses.items():
        for pose in poses:
            rows = list(zip(pose.components, pose.accuracies, pose.repeatabilities, strict=True))
            if pose.accuracy is not None and pose.repeatability is not None:
                rows.insert(0, ("all", pose.accuracy, pose.repeatability))
            for component, accuracy, repeatability in rows:
                named = {"pose": pose.pose, "target": pose.target, "direction": pose.direction}
                named |= {"quantity": quantity, "component": component}
                named["unit"] = SI_SYMBOLS[DIMENSIONS[quantity]]
                for key, word in named.items():
                    words.setdefault(key, []).append(word)
                for key, estimate in (("AP", accuracy), ("RP", repeatability)):
                    for part, value in zip(("", "_low", "_high"), estimate, strict=True):
                        numbers.setdefault(f"{key}{part}", []).append(value)
                numbers.setdefault("visits", []).append(pose.visits)
    row = (ROW,)
    return Records(
        ROW,
        (
            *(Variable(key, row, np.array(values, dtype=str)) for key, values in words.items()),
            *(Variable(key, row, np.array(values)) for key, values in numbers.items()),
        ),
        {ROW: number_from_one(len(words.get("pose", ())))},
    )


@collect_records.register
def collect_budget(result: ErrorBudget) -> Records:
    """Return the part of each source as standard uncertainties (k = 1), and what is left with half
    its sigma [SI].
    """
    lines, source = result.lines, (SOURCE,)
    names = [name_source(line.source.kind, line.source.name) for line in lines]
    halved = [(math.nan, math.nan) if line.halved is None else line.halved[:2] for line in lines]
    variances = np.array([line.parameters for line in lines]).reshape(len(lines), len(result.names))
    table = (
        ("position", [math.sqrt(line.position) for line in lines], "m"),
        ("orientation", [math.sqrt(line.orientation) for line in lines], "rad"),
        ("position_if_halved", [left[0] for left in halved], "m"),
        ("orientation_if_halved", [left[1] for left in halved], "rad"),
    )
    return Records(
        SOURCE,
        (
            Variable("type", source, np.array([line.source.evaluation for line in lines], str)),
            Variable("degrees", source, np.array([line.source.degrees for line in lines]), "1"),
            *(Variable(name, source, np.array(values), unit) for name, values, unit in table),
            Variable("parameter_variance", (SOURCE, OTHER), variances, "square of the SI unit"),
        ),
        {SOURCE: names, OTHER: result.names},
    )


@collect_records.register
def collect_runs(result: RunComparison) -> Records:
    """Return the estimates of each run, and their shifts from the first run, in shown units."""
    factor = np.array([unit.factor_to_si for unit in result.units])
    words = np.array([unit.symbol for unit in result.units], dtype=str)
    variables = [Variable("unit", (RESULT_PARAMETER,), words)]

    def add(name: str, values: list[Any]) -> None:
        numbers = np.array([math.nan if v is None else v for v in values], dtype=float)
        variables.append(Variable(name, (RESULT_PARAMETER,), numbers / factor))

    for run in result.runs:
        add(f"{run.name} estimate", [run.estimates.get(name) for name in result.parameters])
        add(f"{run.name} plus_minus", [run.plus_minus.get(name) for name in result.parameters])
    for pair in result.pairs:
        shifts = [find_shift(pair, name) for name in result.parameters]
        add(f"{pair.second} shift", [shift for shift, _, _ in shifts])
        add(f"{pair.second} shift_sd", [sd for _, sd, _ in shifts])
        significant = np.array([flag for _, _, flag in shifts])
        variables.append(Variable(f"{pair.second} significant", (RESULT_PARAMETER,), significant))
    return Records(RESULT_PARAMETER, tuple(variables), {RESULT_PARAMETER: result.parameters})


# --- The numbers of a result as a table of a page, as a pandas DataFrame and an xarray Dataset.


EXTRA = "tables"
"""Extra of loopcal that installs pandas and xarray."""

MOST_COLUMNS = 16
"""Columns of a table on a page."""


def build_frame(result: object) -> Any:
    """Return the main table of a result as a pandas DataFrame."""
    pandas = import_optional("pandas", EXTRA)
    return pandas.DataFrame(collect_records(result).list_columns())


def build_dataset(result: object) -> Any:
    """Return the arrays of a result as an xarray Dataset."""
    xarray = import_optional("xarray", EXTRA)
    records = collect_records(result)
    used = {name for variable in records.variables for name in variable.dimensions}
    labels = {name: list(values) for name, values in records.labels.items() if name in used}
    arrays, units = {}, {}
    for variable in records.variables:
        arrays[variable.name] = _build_array(variable)
        if not isinstance(variable.unit, str):
            axis = variable.dimensions[-1]
            units[f"{axis}_unit"] = (axis, list(variable.unit))
    return xarray.Dataset(arrays, coords={**labels, **units})


def _build_array(variable: Variable) -> tuple[tuple[str, ...], np.ndarray, dict[str, str]]:
    """Return dimensions, values and attributes of a variable."""
    unit = variable.unit
    if not isinstance(unit, str):
        unit = f"see {variable.dimensions[-1]}_unit"
    return variable.dimensions, np.asarray(variable.values), {"units": unit} if unit else {}


def build_main_table(records: Records, caption: str = "") -> Table:
    """Return the main table for a page; of many columns the first."""
    columns = list(records.list_columns().items())[:MOST_COLUMNS]
    has_numbers = [values.dtype.kind in "iuf" for _, values in columns]
    formatted = [[_format(value) for value in values.tolist()] for _, values in columns]
    return Table(
        caption,
        tuple(
            Column(heading, align="right" if is_number else "left")
            for (heading, _), is_number in zip(columns, has_numbers, strict=True)
        ),
        tuple(zip(*formatted, strict=True)),
    )


def _format(value: Any) -> str:
    """Return a cell."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "unknown" if math.isinf(value) else format_number(value)
    return str(value)


def render_result(result: object) -> str:
    """Return a result as HTML for a notebook."""
    return render_html(write_page(result))


@singledispatch
def write_page(result: object) -> list[Block]:
    """Return the page of a result: its text, and its main table where it has one."""
    if isinstance(result, TableResult):
        return [str(result), build_main_table(collect_records(result))]
    return [str(result)]


def _with_table(text: str, result: object, caption: str = "") -> list[Block]:
    """Return a page with a text and the main table."""
    return [text, build_main_table(collect_records(result), caption)]


@write_page.register
def write_fit(result: Identification) -> list[Block]:
    """Return the page of a fit, and its findings."""
    return [*view_fit(result), *(f"{f.severity.value}: {f}" for f in result.findings)]


@write_page.register
def write_report(result: CalibrationReport) -> list[Block]:
    """Return the page that the command line prints."""
    return view_calibration(result)


@write_page.register
def write_validation(result: Validation) -> list[Block]:
    """Return the page that the command line prints."""
    return view_validation(result, with_before=True, verbose=False)


@write_page.register
def write_heights(result: HeightErrors) -> list[Block]:
    """Return the table that the command line prints."""
    return view_heights(result, verbose=False)


@write_page.register
def write_compensation(result: Compensation) -> list[Block]:
    """Return the targets, and the findings of those that are not reached."""
    return [str(result), *view_compensation(result)]


@write_page.register
def write_identifiability(result: Identifiability) -> list[Block]:
    """Return the findings and the parameters."""
    return _with_table("\n".join(str(finding) for finding in result.findings), result)


@write_page.register
def write_model_choice(result: ModelChoice) -> list[Block]:
    """Return the comparison of parameter sets and the choice."""
    return [build_model_table(result), str(result.finding)]


@write_page.register
def write_curves(result: RegularizationCurves) -> list[Block]:
    """Return the page that the command line prints."""
    return view_regularization(result)


@write_page.register
def write_bootstrap(result: Bootstrap) -> list[Block]:
    """Return findings and intervals."""
    return view_bootstrap(result, result.intervals())


@write_page.register
def write_sample(result: PosteriorSample) -> list[Block]:
    """Return findings and intervals."""
    return view_posterior(result, result.intervals())


@write_page.register
def write_comparison(result: ValueComparison) -> list[Block]:
    """Return the outcome of the test and the differences."""
    return _with_table(str(result.outcome), result, "Estimate minus given value")


@write_page.register
def write_examination(result: FitExamination) -> list[Block]:
    """Return the findings."""
    return ["\n".join(f"{f.severity.value}: {f}" for f in result.findings) or "no findings"]


@write_page.register
def write_cross_validation(result: CrossValidation) -> list[Block]:
    """Return the score and the folds."""
    text = f"Held-out score {result.score:.4g} +/- {result.standard_error:.2g} sigma^2"
    poses = f"{len(result.poses)} rows in {len(result.fold)} folds"
    return _with_table(f"{text}, {poses}; 1 is noise alone.", result)


@write_page.register
def write_map(result: AccuracyMap) -> list[Block]:
    """Return medians and maxima, and the poses."""
    return _with_table(str(result), result, "Poses of the map")


@write_page.register
def write_simulation(result: AccuracySimulation) -> list[Block]:
    """Return predicted and observed errors."""
    counts = f"{result.trials} trials, {result.failed} did not converge"
    return _with_table(f"{counts}; {result.predicted.frame}", result)


@write_page.register
def write_solution(result: Solution) -> list[Block]:
    """Return counts and the poses; readings are in m or rad."""
    return _with_table(repr(result), result)


@write_page.register
def write_runs(result: RunComparison) -> list[Block]:
    """Return the page that the command line prints."""
    return view_comparison(result, find_error_units(result).__getitem__)


@write_page.register
def write_change(result: Change) -> list[Block]:
    """Return whether the machine changed."""
    return [str(result.finding)]


@write_page.register
def write_conformity(result: Conformity) -> list[Block]:
    """Return the decision with its probability; numbers are in m or rad."""
    error = f"error {result.estimate:.4g} (95 %: {result.low:.4g} to {result.high:.4g})"
    decision = f"{result.decision.value} with a probability of {100.0 * result.probability:.3g} %"
    return [f"{error} against a limit of {result.limit:.4g}, all in m or rad: {decision}"]


@write_page.register
def write_repeatability(result: Repeatability) -> list[Block]:
    """Return the page that the command line prints, in mm and deg."""
    return view_repeatability(result)
