# SPDX-License-Identifier: Apache-2.0
"""Judge every claim of the paper, and our own checks, by the numbers of this run."""

from __future__ import annotations

import numpy as np

from loopcal.papers.reproduction import Verdict
from loopcal.papers.tsvd_2016.cases import CHOSEN, LS, PRIOR, RANKED, RE, TSVD
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

ERRORS = ("position", "angle")
NEAR = 0.1
"""k is close to the number of parameters: within this share of it."""


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    words = read_wording(__file__)
    return (
        _judge_noise(words),
        *(_judge_curve(words, d, i) for d in results.draws for i in range(len(ERRORS))),
        _judge_gain(words, results),
        _judge_best(words, results),
        *_judge_five(words, results),
        *_judge_many(words, results),
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
        "noise", agrees=np.abs(shares).max() <= 1.0 and abs(rms - 1.0 / np.sqrt(3.0)) < spread,
        count=shares.size, length=largest[:3].max(), angle=largest[3:].max(),
        degrees=np.rad2deg(largest[3:].max()), rms=rms,
    )  # fmt: skip


def _judge_curve(words: Wording, draws: Draws, i: int) -> Verdict:
    """Judge the median curves over lambda and k for one error: 0 position, 1 angle."""
    settings = {RE: (0.0, *draws.lambdas), TSVD: draws.ks.tolist()}
    shapes = []
    for algorithm, letter in ((RE, "lambda"), (TSVD, "k")):
        curve, values = draws.compute_curve(algorithm)[:, i], settings[algorithm]
        best = int(np.argmin(curve))
        shapes.append(
            {
                "letter": letter,
                "course": "falls" if has_interior_minimum(curve) else "no minimum",
                "first": f"{_format(curve[0])} {('mm', 'deg')[i]} at {letter} = {values[0]:g}",
                "last": f"{_format(curve[-1])} at {values[-1]:g}",
                "least": f"{_format(curve[best])} at {values[best]:.2g}",
            }
        )
    agrees = all(shape["course"] == "falls" for shape in shapes)
    return words.judge("u_shape", agrees=agrees, name=draws.name, error=ERRORS[i], shapes=shapes)


def _judge_gain(words: Wording, results: Results) -> Verdict:
    ratios = {
        draws.name: [draws.compute_ratio(m, RAW_LS)[:2] for m in (RAW_RE, RAW_TSVD)]
        for draws in results.draws
    }
    gains = [
        {
            "name": draws.name,
            "ridge": _format_pair(ratios[draws.name][0]),
            "tsvd": _format_pair(ratios[draws.name][1]),
            "lost": draws.count_diverged(RAW_LS),
        }
        for draws in results.draws
    ]
    agrees = np.all(np.array(list(ratios.values())) < 1.0)
    trials = len(results.draws[0])
    return words.judge("slightly_better", agrees=agrees, trials=trials, gains=gains)


def _judge_best(words: Wording, results: Results) -> Verdict:
    rows, agrees = [], True
    for case in results.cases:
        tsvd, ridge, prior = (case.answers[m].errors for m in (TSVD, RE, PRIOR))
        others = [ridge, prior]
        if not case.answers[LS].is_diverged:
            others.append(case.answers[LS].errors)
        agrees &= all(bool((tsvd[:2] <= other[:2]).all()) for other in others)
        rows.append({"name": case.name, **_format_all(tsvd=tsvd, ridge=ridge, prior=prior)})
    return words.judge("tsvd_best", agrees=agrees, rows=rows)


def _judge_five(words: Wording, results: Results) -> tuple[Verdict, ...]:
    """Judge measurement in five coordinates."""
    fives = [case for case in results.cases if case.study.freedoms == 5]
    nulls, pairs, as_good = [], [], True
    for case in fives:
        six, five = (
            results.find_case(case.study.name, 6).answers[LS].errors,
            case.answers[RANKED].errors,
        )
        as_good &= bool((five[:2] <= 1.1 * six[:2]).all())
        pairs.append({"name": case.study.name, **_format_all(five=five, six=six)})
        combinations = " and ".join(map(str, case.known.unidentifiable))
        nulls.append({"case": case, "last": case.singular_values[-2:], "is": combinations})
    many = []
    for draws in results.draws:
        five, six, prior = (
            draws.compute_median(m) for m in (WHITENED_FIVE, MANY_WHITENED, PRIOR_FIVE)
        )
        many.append({"name": draws.name, **_format_all(five=five, six=six, prior=prior)})
    fails = all(case.answers[LS].is_diverged for case in fives)
    steps = " and ".join(f"{case.normal_equations:.0e}" for case in fives)
    return (
        words.judge("ls_fails", agrees=fails, steps=steps, nulls=nulls),
        words.judge("five_unusable", agrees=not as_good, pairs=pairs, many=many),
        words.judge("no_solution", agrees=not as_good),
    )


def _judge_many(words: Wording, results: Results) -> tuple[Verdict, ...]:
    """Judge the parameters: over many machines, and those of one machine."""
    methods = {"six": PRIOR, "five": PRIOR_FIVE, "raw_six": RAW_LS, "raw_five": RAW_FIVE}
    rows = [
        {"name": d.name, **{key: d.compute_median(m)[3] for key, m in methods.items()}}
        for d in results.draws
    ]
    machines = []
    for name in ("RU-PUS-PRS", "3-PRS"):
        case = results.find_case(name, 6)
        lengths = list_scales(case.study.robot) == MM
        answers = {"ls": case.answers[LS], "prior": case.answers[PRIOR]}
        errors = {k: np.abs(a.values - case.study.trials.truth[0]) for k, a in answers.items()}
        wrong = {f"{k}_wrong": e[lengths].max() / MM for k, e in errors.items()}
        machines.append({"name": name, **answers, **wrong})
    agrees = all(row["five"] > row["six"] for row in rows)
    deviate = all(machine["ls_wrong"] > 0.1 for machine in machines)
    return (
        words.judge("six_better", agrees=agrees, rows=rows),
        words.judge("deviate", agrees=deviate, rows=machines),
    )


def _judge_speed(words: Wording, results: Results) -> Verdict:
    rows = []
    for case in results.cases:
        ls = case.answers[LS if case.study.freedoms == 6 else RANKED]
        others = {"ridge": case.answers[RE], "prior": case.answers[PRIOR]}
        rows.append({"name": case.name, "ls": ls, "tsvd": case.answers[TSVD], **others})
    agrees = all(
        row["tsvd"].is_converged
        and row["tsvd"].iterations <= min(row["ls"].iterations, row["ridge"].iterations)
        for row in rows
    )
    return words.judge("faster", agrees=agrees, rows=rows)


def _judge_lambda(words: Wording, results: Results) -> tuple[Verdict, ...]:
    best = [
        {"name": case.name, "value": case.ridge.settings[case.ridge.best]} for case in results.cases
    ]
    chosen = [
        f"{case.name} {case.answers[CASE_CROSS].setting.removesuffix(CHOSEN)}"
        for case in results.cases
    ]
    ratios = {draws.name: draws.compute_ratio(CROSS, RAW_RE)[:2] for draws in results.draws}
    in_range = all(1e-5 * 0.5 <= row["value"] <= 1.0 for row in best)
    steps = [{"count": count, "value": value} for count, value, _ in results.steps]
    texts = [{"name": name, "ratio": _format_pair(ratio)} for name, ratio in ratios.items()]
    is_worse = bool(np.min(list(ratios.values())) >= 1.0)
    return (
        words.judge("lambda_range", agrees=in_range, best=best, by_steps=steps),
        words.judge("no_rule", agrees=is_worse, chosen=", ".join(chosen), ratios=texts),
    )


def _judge_k(words: Wording, results: Results) -> Verdict:
    rows = [
        {"name": c.name, "k": int(c.truncated.settings[c.truncated.best]),
         "of": len(c.singular_values)}
        for c in results.cases
    ]  # fmt: skip
    agrees = all(row["of"] - NEAR * row["of"] <= row["k"] < row["of"] for row in rows)
    return words.judge("k_near_j", agrees=agrees, rows=rows)


def _judge_own_checks(words: Wording, results: Results) -> tuple[Verdict, ...]:
    """Judge what the paper does not consider: units, priors, rules."""
    both = [results.find_draws(name) for name in ("3-PRS", "RU-PUS-PRS")]
    raw = {"ls": RAW_LS, "ridge": RAW_RE, "tsvd": RAW_TSVD}
    near = [[d.compute_ratio(PRIOR, m)[:2] for m in (CROSS, HINDSIGHT)] for d in both]
    texts = [" and ".join(map(_format_pair, ratios)) for ratios in near]
    parts = [draws.compute_ratio(MANY_WHITENED, RAW_LS)[1] for draws in both]
    rows = [
        {
            "name": draws.name,
            **_format_all(**{k: draws.compute_median(m) for k, m in raw.items()}),
            **_format_all(prior=draws.compute_median(PRIOR)),
        }
        for draws in both
    ]
    case = results.find_case("3-PRS", 6)
    condition = float(case.singular_values[0] / case.singular_values[case.rank - 1])
    better = all((d.compute_ratio(PRIOR, m)[:2] < 1.0).all() for d in both for m in raw.values())
    is_near = all((near[0][i] < limit).all() for i, limit in enumerate((1.05, 1.15)))
    return (
        words.judge(
            "mixed_units", tripod=parts[0], tracker=parts[1], raw=condition,
            whitened=case.known.condition,
        ),
        words.judge("map_better", agrees=better, rows=rows, trials=len(both[0])),
        words.judge("map_near_best", agrees=is_near, tripod=texts[0], tracker=texts[1]),
    )  # fmt: skip


def _format_all(**errors: FloatArray) -> dict[str, str]:
    """Return errors in position and angle as text."""
    return {k: f"{_format(e[0])} mm / {_format(e[1])} deg" for k, e in errors.items()}


def _format_pair(values: FloatArray) -> str:
    return f"{values[0]:.2f} and {values[1]:.2f}"


def _format(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "none (diverged)"
