# SPDX-License-Identifier: Apache-2.0
"""Judge the claims of the paper, and our own checks, on the drawn machines.

The paper simulates one machine of each structure. Here each drawn pair of machines is one draw of
that simulation, and a claim is judged in every draw; it holds in a draw where it holds in all
situations it speaks of. Claims about medians are judged in groups of machines.

Rules are in text.yaml.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.published_steps import LINEARIZATIONS
from loopcal.papers.reproduction import Verdict
from loopcal.papers.tsvd_2016.draw_tables import DIVERGED
from loopcal.papers.tsvd_2016.draws import (
    BEFORE,
    CROSS,
    FACTOR,
    HINDSIGHT,
    NARROW,
    PRIOR,
    PRIOR_FIVE,
    RAW_FIVE,
    RAW_LS,
    RAW_RE,
    RAW_TSVD,
    WHITENED,
    WIDE,
    Draws,
)
from loopcal.papers.tsvd_2016.figures import NUMBERS
from loopcal.papers.tsvd_2016.judgement import (
    format_all,
    format_pair,
    format_ratio,
    judge_groups,
    judge_machines,
)
from loopcal.papers.tsvd_2016.machines import LIMITS
from loopcal.papers.tsvd_2016.published import Published
from loopcal.papers.tsvd_2016.situations import (
    GAIN,
    LS,
    RANKED,
    RE,
    SHORT,
    TSVD,
    Situation,
    compute_rises,
    find_bottom,
)
from loopcal.papers.tsvd_2016.tables import Results
from loopcal.papers.wording import Wording, read_wording

ERRORS = ("position", "angle")
UNITS = ("mm", "deg")


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    words = read_wording(__file__)
    situations = [situation for draws in results.draws for situation in draws.situations]
    with np.errstate(divide="ignore", invalid="ignore"):
        return (
            *(_judge_curve(words, situation) for situation in situations),
            _judge_availability(words, results.draws),
            _judge_gain(words, results.draws),
            _judge_best(words, situations),
            _judge_failure(words, results.draws),
            _judge_existence(words, results.draws),
            _judge_parameters(words, results.draws),
            _judge_deviation(words, results.draws),
            _judge_speed(words, situations),
            _judge_lambda(words, results),
            _judge_rule(words, results.draws),
            _judge_k(words, situations),
            _judge_noise(words, results.printed),
            _judge_rank_detection(words, results.draws),
            _judge_units(words, results.draws),
            *_judge_prior(words, results.draws),
        )


def _judge_curve(words: Wording, situation: Situation) -> Verdict:
    """Judge the curves over lambda and k of one figure: position and angle, each machine."""
    places = {
        error: {
            "least_ridge": situation.compute_rises(RE, i),
            "least_tsvd": situation.compute_rises(TSVD, i),
        }
        for i, error in enumerate(ERRORS)
    }
    curves = [
        {
            "letter": "lambda" if algorithm == RE else "k",
            "error": error,
            "count": int((situation.compute_rises(algorithm, i) > GAIN).sum()),
            "of": len(situation),
            **_describe_curve(situation, algorithm, i),
        }
        for algorithm in (RE, TSVD)
        for i, error in enumerate(ERRORS)
    ]
    short = [int((compute_rises(situation.short[:, :, i]) > GAIN).sum()) for i in (0, 1)]
    return judge_machines(
        words, "u_shape", places, name=situation.label, curves=curves, iterations=SHORT,
        number=NUMBERS[situation.name, situation.freedoms], short=short,
    )  # fmt: skip


def _describe_curve(situation: Situation, algorithm: str, i: int) -> dict[str, str]:
    curve = np.median(situation.get_curves(algorithm)[:, :, i], axis=0)
    settings, usable = situation.get_settings(algorithm), np.flatnonzero(np.isfinite(curve))
    if not usable.size:
        return dict.fromkeys(("first", "least", "last"), DIVERGED)
    best = int(usable[np.argmin(curve[usable])])
    return {
        name: f"{curve[j]:.2g} {UNITS[i]} at {settings[j]:.2g}"
        for name, j in (("first", usable[0]), ("least", best), ("last", usable[-1]))
    }


def _judge_availability(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    places = {}
    for draw in draws:
        chosen = draw.six.chosen[LS]
        places[draw.six.label] = {
            "most_diverged": np.isinf(chosen.errors[:, 0]).astype(float),
            "most_iterations": chosen.iterations.astype(float),
        }
    lost = [
        {
            "name": label,
            "diverged": int(numbers["most_diverged"].sum()),
            "slow": int((numbers["most_iterations"] >= LINEARIZATIONS).sum()),
        }
        for label, numbers in places.items()
    ]
    return judge_machines(words, "ls_stable", places, lost=lost, limit=LINEARIZATIONS)


def _judge_gain(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    """Judge RE and TSVD against LS with settings that were best on other machines."""
    places, gains = {}, []
    for draw in draws:
        ridge, tsvd = (draw.six.compare_unseen(algorithm) for algorithm in (RE, TSVD))
        places[draw.six.label] = {"most_ridge": ridge.max(axis=1), "most_tsvd": tsvd.max(axis=1)}
        middle = {"ridge": format_pair(np.median(ridge, axis=0)),
                  "tsvd": format_pair(np.median(tsvd, axis=0))}  # fmt: skip
        gains.append({"name": draw.six.label, **middle})
    return judge_machines(words, "ls_not_best", places, gains=gains)


def _judge_best(words: Wording, situations: list[Situation]) -> Verdict:
    """Judge TSVD against LS and RE, each of the three at the bottom of its curve."""
    places, rows = {}, []
    for situation in situations:
        chosen = situation.chosen
        tsvd = chosen[TSVD].errors[:, :2]
        places[situation.label] = {
            "most_ridge": (tsvd / chosen[RE].errors[:, :2]).max(axis=1),
            "most_ls": (tsvd / chosen[LS].errors[:, :2]).max(axis=1),
        }
        after = chosen[TSVD].commanded / chosen[RE].commanded
        medians = {m: np.median(chosen[a].errors, axis=0)
                   for m, a in (("tsvd", TSVD), ("ridge", RE), ("ls", LS))}  # fmt: skip
        commanded = int((after.max(axis=1) <= 1.0).sum())
        rows.append({"name": situation.label, "commanded": commanded, **format_all(**medians)})
    return judge_machines(words, "tsvd_best", places, rows=rows, trials=len(situations[0]))


def _judge_failure(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    """Judge 5-DOF measurement: LS diverges, RE and TSVD improve the machine."""
    places = {}
    for draw in draws:
        chosen, before = draw.five.chosen, draw.errors[BEFORE][:, :2]
        left = {a: (chosen[a].errors[:, :2] / before).max(axis=1) for a in (RE, TSVD)}
        diverged = np.isinf(chosen[LS].errors[:, 0]).astype(float)
        places[draw.five.label] = {
            "least_diverged": diverged, "most_ridge": left[RE], "most_tsvd": left[TSVD],
        }  # fmt: skip
    rows = [
        {"name": label, "diverged": int(n["least_diverged"].sum()), "of": len(n["most_ridge"]),
         "ridge": float(np.median(n["most_ridge"])), "tsvd": float(np.median(n["most_tsvd"]))}
        for label, n in places.items()
    ]  # fmt: skip
    return judge_machines(words, "ls_fails", places, rows=rows)


def _judge_existence(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    """Judge whether exact 5-DOF measurements leave an error of the poses."""
    places, rows = {}, []
    for draw in draws:
        left = draw.five.exact[:, :2] / draw.errors[BEFORE][:, :2]
        places[draw.five.label] = {"least_left": left.max(axis=1)}
        largest = draw.five.exact.max(axis=0)
        rows.append({"name": draw.five.label, "left": f"{largest[0]:.0e} mm / {largest[1]:.0e} deg",
                     "parameters": float(np.median(draw.five.exact[:, 3]))})  # fmt: skip
    return judge_machines(words, "no_solution", places, rows=rows)


def _judge_parameters(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    """Judge the parameter errors of the paper's RE and TSVD with 5- against 6-DOF measurement."""
    places, rows = {}, []
    for draw in draws:
        ratios = {
            a: draw.five.chosen[a].errors[:, 3] / draw.six.chosen[a].errors[:, 3]
            for a in (RE, TSVD)
        }
        places[draw.name] = {"least_ridge": ratios[RE], "least_tsvd": ratios[TSVD]}
        medians = {
            f"{key}_{f}": float(np.median(situation.chosen[a].errors[:, 3]))
            for key, a in (("ridge", RE), ("tsvd", TSVD))
            for f, situation in (("six", draw.six), ("five", draw.five))
        }
        prior = {"six": draw.compute_median(PRIOR)[3], "five": draw.compute_median(PRIOR_FIVE)[3]}
        rows.append({"name": draw.name, **medians, **prior})
    return judge_machines(words, "six_better", places, rows=rows)


def _judge_deviation(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    """Judge both halves: parameters farther from the truth than nominal, and better poses."""
    places, rows = {}, []
    for draw in draws:
        for situation in draw.situations:
            used = [situation.chosen[a] for a in (RANKED, RE, TSVD)]
            worse = np.array([c.errors[:, 4] for c in used])
            left = np.array([(c.errors[:, :2] / draw.errors[BEFORE][:, :2]).max(axis=1)
                             for c in used])  # fmt: skip
            numbers = {"least_worse": worse.min(axis=0), "most_left": left.max(axis=0)}
            places[situation.label] = numbers
            shares = dict(zip(("ls", "ridge", "tsvd"), np.median(worse, axis=1), strict=True))
            rows.append({"name": situation.label, **shares, "left": np.median(left)})
    return judge_machines(words, "deviate", places, rows=rows)


def _judge_speed(words: Wording, situations: list[Situation]) -> Verdict:
    places, rows = {}, []
    for situation in situations:
        counts = {a: situation.chosen[a].iterations for a in (RANKED, RE, TSVD)}
        places[situation.label] = {
            "most_ls": counts[TSVD] / counts[RANKED], "most_ridge": counts[TSVD] / counts[RE]
        }  # fmt: skip
        middle = {key: f"{np.median(counts[a]):,.0f}"
                  for key, a in (("ls", RANKED), ("ridge", RE), ("tsvd", TSVD))}  # fmt: skip
        rows.append({"name": situation.label, **middle})
    return judge_machines(words, "faster", places, rows=rows)


def _judge_lambda(words: Wording, results: Results) -> Verdict:
    """Judge the range of the best lambda, looked for beyond that range, and its differences."""
    best = {s.label: s.chosen[RE].settings for d in results.draws for s in d.situations}
    first, *others = (draws.six.chosen[RE].settings for draws in results.draws)
    apart = np.max([np.maximum(first / other, other / first) for other in others], axis=0)
    values = np.array(list(best.values()))
    numbers = {"least_lambda": values.min(axis=0), "most_lambda": values.max(axis=0),
               "least_factor": apart}  # fmt: skip
    rows = [
        {"name": name, "low": settings.min(), "middle": np.median(settings),
         "high": settings.max()}
        for name, settings in best.items()
    ]  # fmt: skip
    steps = [
        {"end": f"after {count}" if isinstance(count, int) else count, "value": value}
        for count, value, _ in results.steps
    ]
    searched = results.draws[0].six.lambdas
    return judge_machines(
        words, "lambda_range", {"all": numbers}, rows=rows, by_steps=steps, low=searched.min(),
        high=searched.max(),
    )  # fmt: skip


def _judge_rule(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    ratios = [{"name": d.name, "ratio": format_pair(d.compute_ratio(CROSS, RAW_RE))}
              for d in draws]  # fmt: skip
    return judge_groups(words, "no_rule", draws, {"most": [(CROSS, RAW_RE)]}, ratios=ratios)


def _judge_k(words: Wording, situations: list[Situation]) -> Verdict:
    """Judge the best k, all parameters included, by its distance from their number."""
    places, rows = {}, []
    for situation in situations:
        p = int(situation.ks[0])
        best = np.array([situation.ks[find_bottom(curve)] for curve in situation.truncated])
        distance = (p - best) / p
        places[situation.label] = {"most_distance": distance, "least_distance": distance}
        rows.append({"name": situation.label, "low": int(best.min()), "high": int(best.max()),
                     "middle": float(np.median(best)), "of": p})  # fmt: skip
    return judge_machines(words, "k_near_j", places, rows=rows)


def _judge_noise(words: Wording, published: Published) -> Verdict:
    noise = published.noise.values
    shares = published.noise_si / LIMITS
    largest, rms = np.abs(noise).max(axis=0), float(np.sqrt(np.mean(shares**2)))
    # three standard deviations of the rms of that many uniform numbers
    spread = 3.0 * np.sqrt(4.0 / 45.0 / shares.size) / (2.0 / np.sqrt(3.0))
    return words.judge(
        "noise", largest=float(np.abs(shares).max()), off=abs(rms - 1.0 / np.sqrt(3.0)),
        allowed=spread, count=shares.size, length=largest[:3].max(), angle=largest[3:].max(),
        degrees=np.rad2deg(largest[3:].max()), rms=rms,
    )  # fmt: skip


def _judge_rank_detection(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    rows = [
        {"name": d.name, **format_all(five=d.compute_median(RAW_FIVE),
                                       six=d.compute_median(RAW_LS))}
        for d in draws
    ]  # fmt: skip
    return judge_groups(words, "five_usable", draws, {"most": [(RAW_FIVE, RAW_LS)]}, rows=rows)


def _judge_units(words: Wording, draws: tuple[Draws, ...]) -> Verdict:
    ratios = [{"name": d.name, "ratio": format_ratio(d.compute_ratio(WHITENED, RAW_LS)[1])}
              for d in draws]  # fmt: skip
    numbers = {"most_angle": [(WHITENED, RAW_LS)]}
    return judge_groups(words, "mixed_units", draws, numbers, ratios=ratios)


def _judge_prior(words: Wording, draws: tuple[Draws, ...]) -> tuple[Verdict, ...]:
    """Judge MAP: against the raw methods, near the best choice, and with wrong tolerances."""
    raw = (RAW_LS, RAW_RE, RAW_TSVD)
    rows = [
        {"name": d.name,
         **format_all(prior=d.compute_median(PRIOR), narrow=d.compute_median(NARROW),
                       wide=d.compute_median(WIDE), ls=d.compute_median(RAW_LS),
                       ridge=d.compute_median(RAW_RE), tsvd=d.compute_median(RAW_TSVD)),
         "gcv": format_pair(d.compute_ratio(PRIOR, CROSS)),
         "hindsight": format_pair(d.compute_ratio(PRIOR, HINDSIGHT))}
        for d in draws
    ]  # fmt: skip
    better = {"most": [(PRIOR, m) for m in raw]}
    wrong = {"most": [(p, m) for p in (NARROW, WIDE) for m in raw]}
    near = {"gcv": [(PRIOR, CROSS)], "hindsight": [(PRIOR, HINDSIGHT)]}
    tripod = tuple(d for d in draws if d.name == "3-PRS")
    return (
        judge_groups(words, "map_better", draws, better, rows=rows),
        judge_groups(words, "map_tolerances", draws, wrong, rows=rows, factor=FACTOR),
        judge_groups(words, "map_near_best", tripod, near, rows=rows),
    )
