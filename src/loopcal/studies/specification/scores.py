# SPDX-License-Identifier: Apache-2.0
"""The scores of trials: what each column of the results of a block contains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.studies.specification.levels import FACTORS, Question, Scores, list_chains
from loopcal.units import SI_SYMBOLS, Dimension, find_unit, parse_quantity

if TYPE_CHECKING:
    from loopcal.studies.specification.study import Study


@dataclass(frozen=True)
class ScoreColumn:
    """A column of the results of trials. `unit` : "m", "rad" or "1"."""

    name: str
    unit: str
    meaning: str


COLUMNS = (
    ScoreColumn("outcome", "1", "0 for a trial that converged, else the number of a code"),
    ScoreColumn("position_before", "m", "held-out position error before calibration, rms"),
    ScoreColumn("position_before_max", "m", "held-out position error before calibration, largest"),
    ScoreColumn("position", "m", "held-out position error after calibration, rms"),
    ScoreColumn("position_max", "m", "held-out position error after calibration, largest"),
    ScoreColumn("orientation_before", "rad", "held-out rotation error before calibration, rms"),
    ScoreColumn(
        "orientation_before_max", "rad", "held-out rotation error before calibration, largest"
    ),
    ScoreColumn("orientation", "rad", "held-out rotation error after calibration, rms"),
    ScoreColumn("orientation_max", "rad", "held-out rotation error after calibration, largest"),
    ScoreColumn("parameters", "1", "error of the parameters over their tolerances, rms"),
    ScoreColumn("parameters_max", "1", "error of the parameters over their tolerances, largest"),
    ScoreColumn("lengths", "m", "error of the parameters that are lengths, rms"),
    ScoreColumn("angles", "rad", "error of the parameters that are angles, rms"),
    ScoreColumn("covered_parameters", "1", "share of the parameters in their 95 % intervals"),
    ScoreColumn("covered_position", "1", "share of held-out poses with position error below U95"),
    ScoreColumn(
        "covered_orientation", "1", "share of held-out poses with rotation error below U95"
    ),
    ScoreColumn("rank", "1", "number of combinations of parameters that the data determine"),
    ScoreColumn("condition", "1", "condition number of the scaled rows"),
    ScoreColumn("iterations", "1", "steps of the fit"),
    ScoreColumn("noise_scale", "1", "residuals over stated noise"),
)
"""Columns of every study."""

VERDICT_COLUMNS = (
    ScoreColumn("verdict", "1", "0 calibrated, 1 with reservations, 2 undecided, 3 not calibrated"),
)
"""Further columns of a study that calibrates every trial in full."""

BASE_COLUMNS = (
    ScoreColumn("position_base_before", "m", "position error before, in the base frame, rms"),
    ScoreColumn("position_base", "m", "position error after, in the base frame, rms"),
    ScoreColumn("orientation_base_before", "rad", "rotation error before, in the base frame, rms"),
    ScoreColumn("orientation_base", "rad", "rotation error after, in the base frame, rms"),
)
"""Further columns of a study that states errors in both frames."""


def list_columns(scores: Scores) -> tuple[ScoreColumn, ...]:
    """Return the columns of the results of trials."""
    verdict = VERDICT_COLUMNS if scores.verdict else ()
    return (*COLUMNS, *verdict, *(BASE_COLUMNS if scores.frame == "both" else ()))


MORE_IS_BETTER = ("covered_", "rank")
"""Beginning of the names of scores that have no upper limit."""


def check_question(study: Study, question: Question) -> float:
    """Return the limit of a question [SI].

    Raises DataError: a factor or a score that the study does not have, a factor whose levels have
    no order, a score of which more is better, or a limit in another unit.
    """
    factors = tuple(FACTORS.values())
    if question.factor not in factors:
        raise DataError(
            f"factor is {question.factor!r}{suggest_names(question.factor, factors)}; it must be "
            f"one of {', '.join(factors)}"
        )
    chains = list_chains(study, question.factor)
    if len(chains) > 1 and all(len(chain.levels) == 1 for chain in chains):
        named = ", ".join(chain.levels[0] for chain in chains)
        raise DataError(
            f"factor is {question.factor!r}, whose levels ({named}) have no order, so none is the "
            f"{question.wanted}; ask for a factor whose levels differ in a number"
        )
    columns = {
        column.name: column
        for column in list_columns(study.scores)[1:]
        if not column.name.startswith(MORE_IS_BETTER)
    }
    if question.score not in columns:
        raise DataError(
            f"score is {question.score!r}{suggest_names(question.score, columns)}; it must be one "
            f"of {', '.join(columns)}"
        )
    unit = columns[question.score].unit
    try:
        if unit == SI_SYMBOLS[Dimension.RATIO]:
            return float(question.limit)
        return parse_quantity(str(question.limit), find_unit(unit).dimension)
    except UnitError as error:
        raise DataError(f"limit: {error}") from None
    except ValueError:
        raise DataError(
            f"limit is {question.limit!r}, but {question.score} has no unit; give a number"
        ) from None
