# SPDX-License-Identifier: Apache-2.0
"""The numbers of fits, of what they determine, and of their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from loopcal.diagnose import (
    CrossValidation,
    Identifiability,
    ModelChoice,
    OutlierCheck,
    RegularizationCurves,
    ValueComparison,
)
from loopcal.estimate import Identification, IdentifiedTrials
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.residuals import KindResiduals
from loopcal.report.notebook.records import (
    OTHER,
    Records,
    Variable,
    collect_records,
    number_from_one,
)
from loopcal.sampling import (
    Bootstrap,
    Intervals,
    JointRegion,
    PosteriorSample,
    SimultaneousIntervals,
)
from loopcal.units import SI_SYMBOLS
from loopcal.workflow import CalibrationReport

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
