# SPDX-License-Identifier: Apache-2.0
"""Judge every claim of the paper, and our own checks, by the numbers of this run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.papers.reproduction import Verdict
from loopcal.papers.tsvd_2016.cases import CHOSEN, LS, PRIOR, RANKED, RE, TSVD, Case
from loopcal.papers.tsvd_2016.cases import CROSS as CASE_CROSS
from loopcal.papers.tsvd_2016.draws import (
    CROSS,
    HINDSIGHT,
    PRIOR_FIVE,
    RAW_FIVE,
    RAW_LS,
    RAW_RE,
    RAW_TSVD,
    WHITENED_FIVE,
    Draws,
    has_interior_minimum,
)
from loopcal.papers.tsvd_2016.draws import WHITENED as MANY_WHITENED
from loopcal.papers.tsvd_2016.machines import LIMITS
from loopcal.papers.tsvd_2016.published import MM, read_published
from loopcal.papers.tsvd_2016.steps import list_scales
from loopcal.papers.tsvd_2016.tables import Results
from loopcal.papers.wording import Wording, read_wording
from loopcal.typing import FloatArray

NEAR = 0.1
"""k is close to the number of parameters: within this share of it."""


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    words = read_wording(__file__)
    return (
        _judge_noise(words),
        *_judge_curves(words, results),
        _judge_gain(words, results),
        _judge_best(words, results),
        *_judge_five(words, results),
        _judge_deviation(words, results),
        _judge_speed(words, results),
        *_judge_lambda(words, results),
        _judge_k(words, results),
        *_judge_own_checks(words, results),
    )


def _judge_noise(words: Wording) -> Verdict:
    published = read_published()
    shares = published.noise_si / LIMITS
    largest, rms = np.abs(published.noise.values).max(axis=0), float(np.sqrt(np.mean(shares**2)))
    # three standard deviations of the rms of that many uniform numbers
    spread = 3.0 * np.sqrt(4.0 / 45.0 / shares.size) / (2.0 / np.sqrt(3.0))
    return words.judge(
        "noise",
        agrees=np.abs(shares).max() <= 1.0 and abs(rms - 1.0 / np.sqrt(3.0)) < spread,
        count=shares.size,
        length=largest[:3].max(),
        angle=largest[3:].max(),
        degrees=np.rad2deg(largest[3:].max()),
        rms=rms,
    )


def _judge_curves(words: Wording, results: Results) -> list[Verdict]:
    """Judge the curves over lambda and k, by manipulator and error."""
    verdicts = []
    for draws in results.draws:
        for i, error in enumerate(("position", "angle")):
            curves = {a: draws.compute_curve(a)[:, i] for a in (RE, TSVD)}
            verdicts.append(
                words.judge(
                    "u_shape",
                    agrees=all(has_interior_minimum(curve) for curve in curves.values()),
                    name=draws.name,
                    error=error,
                    shapes=[_describe_curve(draws, a, i) for a in curves],
                )
            )
    return verdicts


def _describe_curve(draws: Draws, algorithm: str, i: int) -> str:
    """Return the course of one median curve in words."""
    curve = draws.compute_curve(algorithm)[:, i]
    settings: Sequence[float] = draws.ks.tolist()
    letter, unit = ("k", "lambda")[algorithm == RE], ("mm", "deg")[i]
    if algorithm == RE:
        settings = (0.0, *draws.lambdas)
    best = int(np.argmin(curve))
    ends = (
        f"{_format(curve[0])} {unit} at {letter} = {settings[0]:g} and {_format(curve[-1])} at "
        f"{settings[-1]:g}"
    )
    least = f"{_format(curve[best])} at {settings[best]:.2g}"
    if has_interior_minimum(curve):
        return f"over {letter} the median error falls from {ends} to {least}"
    return f"over {letter} it has no interior minimum: {ends}, least {least}"


def _judge_gain(words: Wording, results: Results) -> Verdict:
    gains, agrees = [], True
    for draws in results.draws:
        ratio = np.stack([draws.compute_ratio(m, RAW_LS)[:2] for m in (RAW_RE, RAW_TSVD)])
        agrees &= bool((ratio < 1.0).all())
        count = draws.count_diverged(RAW_LS)
        lost = f" (LS diverged for {count})" if count else ""
        gains.append(
            f"{draws.name} RE {_format_pair(ratio[0])}, TSVD {_format_pair(ratio[1])}{lost}"
        )
    return words.judge(
        "slightly_better", agrees=agrees, trials=len(results.draws[0]), gains="; ".join(gains)
    )


def _judge_best(words: Wording, results: Results) -> Verdict:
    rows, agrees = [], True
    for case in results.cases:
        answers = case.answers
        ridge, tsvd, prior = (answers[m].errors for m in (RE, TSVD, PRIOR))
        others = [ridge, prior]
        if not answers[LS].is_diverged:
            others.append(answers[LS].errors)
        agrees &= all(bool((tsvd[:2] <= other[:2]).all()) for other in others)
        texts = (_format_errors(errors) for errors in (tsvd, ridge, prior))
        rows.append("{}: TSVD {}, RE {}, MAP {}".format(case.name, *texts))
    return words.judge("tsvd_best", agrees=agrees, rows="; ".join(rows))


def _judge_five(words: Wording, results: Results) -> tuple[Verdict, ...]:
    fives = [case for case in results.cases if case.study.freedoms == 5]
    nulls = []
    as_good, pairs = True, []
    for case in fives:
        s = case.singular_values
        combinations = " and ".join(map(str, case.known.unidentifiable))
        nulls.append(
            f"{case.study.name}: rank {case.rank} of {len(s)}, singular value {s[-1]:.0e} after "
            f"{s[-2]:.1e}, {combinations}"
        )
        six = results.find_case(case.study.name, 6).answers[LS].errors
        five = case.answers[RANKED].errors
        as_good &= bool((five[:2] <= 1.1 * six[:2]).all())
        pairs.append(f"{case.study.name}: {_format_errors(five)}, with 6-DOF {_format_errors(six)}")
    many = []
    for draws in results.draws:
        medians = (draws.compute_median(m) for m in (WHITENED_FIVE, MANY_WHITENED, PRIOR_FIVE))
        texts = (_format_errors(errors) for errors in medians)
        many.append("{}: whitened LS {} against {}, MAP {}".format(draws.name, *texts))
    return (
        words.judge(
            "ls_fails",
            agrees=all(case.answers[LS].is_diverged for case in fives),
            steps=" and ".join(f"{case.normal_equations:.0e}" for case in fives),
            nulls="; ".join(nulls),
        ),
        words.judge(
            "five_unusable", agrees=not as_good, pairs="; ".join(pairs), many="; ".join(many)
        ),
        words.judge("no_solution", agrees=not as_good),
        _judge_six(words, results),
    )


def _judge_six(words: Wording, results: Results) -> Verdict:
    rows, agrees = [], True
    for draws in results.draws:
        six, five, raw_six, raw_five = (
            draws.compute_median(m)[3] for m in (PRIOR, PRIOR_FIVE, RAW_LS, RAW_FIVE)
        )
        agrees &= bool(five > six)
        rows.append(
            f"{draws.name} MAP {six:.3g} tolerances rms with six, {five:.3g} with five (raw LS "
            f"{raw_six:.2g} and {raw_five:.2g})"
        )
    return words.judge("six_better", agrees=agrees, rows="; ".join(rows))


def _judge_deviation(words: Wording, results: Results) -> Verdict:
    rows, agrees = [], True
    for name in ("RU-PUS-PRS", "3-PRS"):
        case = results.find_case(name, 6)
        true = case.study.trials.truth[0]
        lengths = list_scales(case.study.robot) == MM
        ls, prior = case.answers[LS], case.answers[PRIOR]
        wrong = [np.abs(a.values - true)[lengths].max() / MM for a in (ls, prior)]
        agrees &= bool(wrong[0] > 0.1)
        rows.append(
            f"{name}: the largest parameter error of LS is {wrong[0]:.2g} mm at a position error "
            f"of {ls.errors[0]:.2g} mm, that of MAP {wrong[1]:.2g} mm at {prior.errors[0]:.2g} mm"
        )
    return words.judge("deviate", agrees=agrees, rows="; ".join(rows))


def _judge_speed(words: Wording, results: Results) -> Verdict:
    rows, agrees = [], True
    for case in results.cases:
        ls = case.answers[LS if case.study.freedoms == 6 else RANKED]
        ridge, tsvd = case.answers[RE], case.answers[TSVD]
        agrees &= tsvd.is_converged and tsvd.iterations <= min(ls.iterations, ridge.iterations)
        rows.append(
            f"{case.name}: LS {ls.needed}, RE {ridge.needed}, TSVD {tsvd.needed}, MAP "
            f"{case.answers[PRIOR].iterations}"
        )
    return words.judge("faster", agrees=agrees, rows="; ".join(rows))


def _judge_lambda(words: Wording, results: Results) -> tuple[Verdict, ...]:
    best = {case.name: case.ridge.settings[case.ridge.best] for case in results.cases}
    chosen = [
        f"{case.name} {case.answers[CASE_CROSS].setting.removesuffix(CHOSEN)}"
        for case in results.cases
    ]
    ratios = {draws.name: draws.compute_ratio(CROSS, RAW_RE)[:2] for draws in results.draws}
    return (
        words.judge(
            "lambda_range",
            agrees=all(1e-5 * 0.5 <= value <= 1.0 for value in best.values()),
            best=", ".join(f"{name} {value:.2g}" for name, value in best.items()),
            by_steps=", ".join(f"{lam:.2g} after {count}" for count, lam, _ in results.steps),
        ),
        words.judge(
            "no_rule",
            agrees=bool(np.min(list(ratios.values())) >= 1.0),
            chosen=", ".join(chosen),
            ratios="; ".join(f"{name} {_format_pair(ratio)}" for name, ratio in ratios.items()),
        ),
    )


def _judge_k(words: Wording, results: Results) -> Verdict:
    best = {
        case.name: (int(case.truncated.settings[case.truncated.best]), len(case.singular_values))
        for case in results.cases
    }
    return words.judge(
        "k_near_j",
        agrees=all(p - NEAR * p <= k < p for k, p in best.values()),
        rows=", ".join(f"{name} {k} of {p}" for name, (k, p) in best.items()),
    )


def _judge_own_checks(words: Wording, results: Results) -> tuple[Verdict, ...]:
    """Judge what the paper does not consider: units, priors, rules."""
    both = tripod, tracker = results.find_draws("3-PRS"), results.find_draws("RU-PUS-PRS")
    raw = (RAW_LS, RAW_RE, RAW_TSVD)
    near = {d.name: [d.compute_ratio(PRIOR, m)[:2] for m in (CROSS, HINDSIGHT)] for d in both}
    parts = [draws.compute_ratio(MANY_WHITENED, RAW_LS)[1] for draws in both]
    texts = {name: " and ".join(map(_format_pair, ratios)) for name, ratios in near.items()}
    rows = []
    for draws in both:
        errors = (_format_errors(draws.compute_median(method)) for method in (PRIOR, *raw))
        rows.append("{}: MAP {}, raw LS {}, best RE {}, best TSVD {}".format(draws.name, *errors))
    case = results.find_case("3-PRS", 6)
    return (
        words.judge(
            "mixed_units",
            tripod=parts[0],
            tracker=parts[1],
            raw=_compute_condition(case),
            whitened=case.known.condition,
        ),
        words.judge(
            "map_better",
            agrees=all((d.compute_ratio(PRIOR, m)[:2] < 1.0).all() for d in both for m in raw),
            rows="; ".join(rows),
            trials=len(tripod),
        ),
        words.judge(
            "map_near_best",
            agrees=bool(
                (near[tripod.name][0] < 1.05).all() and (near[tripod.name][1] < 1.15).all()
            ),
            tripod=texts[tripod.name],
            tracker=texts[tracker.name],
        ),
    )


def _compute_condition(case: Case) -> float:
    return float(case.singular_values[0] / case.singular_values[case.rank - 1])


def _format_errors(values: FloatArray) -> str:
    return f"{_format(values[0])} mm / {_format(values[1])} deg"


def _format_pair(values: FloatArray) -> str:
    return f"{values[0]:.2f} and {values[1]:.2f}"


def _format(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "none (diverged)"
