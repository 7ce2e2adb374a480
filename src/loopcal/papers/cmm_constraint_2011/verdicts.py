# SPDX-License-Identifier: Apache-2.0
"""Judge every claim of the paper, and our own checks, by the numbers of this run."""

from __future__ import annotations

import numpy as np

from loopcal.papers.cmm_constraint_2011.cells import (
    BEFORE,
    LS,
    METHODS,
    PRIOR,
    compute_rank_correlation,
)
from loopcal.papers.cmm_constraint_2011.fifty_points import STATISTICS, FiftyPoints
from loopcal.papers.cmm_constraint_2011.gauge import list_gauge_directions
from loopcal.papers.cmm_constraint_2011.layouts import (
    ANY,
    NOISE,
    ONE,
    SET,
    TEN,
    VARIANCE,
    Arrangement,
)
from loopcal.papers.cmm_constraint_2011.machines import ABSOLUTE, ALIGNED, AT_NOMINAL, MEASURES
from loopcal.papers.cmm_constraint_2011.published import MM, read_published
from loopcal.papers.cmm_constraint_2011.tables import Results, compute_pair_rank
from loopcal.papers.reproduction import Verdict
from loopcal.papers.wording import Wording, read_wording

PARAMETERS, POSITION = MEASURES.index("parameters [mm]"), MEASURES.index("position [mm]")
POSITION_ALIGNED = MEASURES.index("position, aligned [mm]")
PARAMETERS_WITHOUT_GAUGE = MEASURES.index("parameters without gauge [mm]")
SURE = 0.1
"""A ratio of two medians of some fifty machines, minus one, that is not significant."""


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    words = read_wording(__file__)
    return (
        _judge_independence(words, results),
        _judge_count(words, results),
        _judge_least_squares(words, results),
        _judge_three_quarters(words, results),
        _judge_improvement(words, results),
        _judge_correlation(words, results),
        *_judge_figure_5(words, results),
        *_judge_points(words, results),
        *_judge_fifty(words, results),
        *_judge_arithmetic(words),
        _judge_prior(words, results),
        _judge_weights(words, results),
        _judge_forms(words, results),
    )


def _judge_independence(words: Wording, results: Results) -> Verdict:
    rows = results.study.optimized.rows.reshape(-1, 42)
    moved = rows @ list_gauge_directions(results.study.robot)[:6].T
    effect = np.abs(moved).max() / np.abs(rows).max()
    return words.judge("independent", effect=effect)


def _judge_count(words: Wording, results: Results) -> Verdict:
    points, rank = compute_pair_rank(results.study)
    agrees = None if rank == points - 2 else rank == points - 1
    return words.judge("counted", agrees=agrees, points=points, rank=rank)


def _judge_least_squares(words: Wording, results: Results) -> Verdict:
    ranks = sorted({r.rank for r in results.ranks})
    groups = [r.groups for r in results.ranks]
    unused = [r.singular_values[r.rank] / r.singular_values[0] for r in results.ranks]
    return words.judge(
        "least_squares",
        agrees=ranks == [42],
        ranks=ranks,
        fewest=min(groups),
        most=max(groups),
        largest=max(unused),
    )


def _judge_three_quarters(words: Wording, results: Results) -> Verdict:
    from scipy.stats import beta

    quiet = results.cells["1", "0.0001"]
    share = quiet.errors[LS][:, PARAMETERS] / quiet.errors[BEFORE][:, PARAMETERS]
    return words.judge(
        "three_quarters",
        agrees=np.mean(share) <= 0.25,
        chance=100.0 * float(beta.cdf(0.25**2, 4.5, 16.5)),
        noise=quiet.noise / MM,
        mean=100.0 * (1.0 - share.mean()),
        reached=int((share <= 0.25).sum()),
        count=len(share),
    )


def _judge_improvement(words: Wording, results: Results) -> Verdict:
    errors = {
        key: (c.compute_median(BEFORE)[POSITION_ALIGNED], c.compute_median(LS)[POSITION_ALIGNED])
        for key, c in results.cells.items()
    }
    worse = [key for key, (before, after) in errors.items() if after > before]
    ratios = [errors[key][1] * MM / c.noise for key, c in results.cells.items()]
    return words.judge(
        "better",
        ratio=np.median(ratios),
        better=len(errors) - len(worse),
        count=len(errors),
        worse=", ".join(f"errors {s} mm with noise {n} mm" for s, n in worse) or "none",
    )


def _judge_correlation(words: Wording, results: Results) -> Verdict:
    cells = results.cells.values()
    ranks = {method: compute_rank_correlation(cells, method) for method in METHODS}
    reduction = results.cells["1", "0.01"].compute_reduction(LS)
    return words.judge(
        "correlation",
        count=len(cells),
        ratios=len({c.ratio for c in cells}),
        ls=ranks[LS],
        prior=ranks[PRIOR],
        parameters=reduction[PARAMETERS],
        position=reduction[POSITION],
        aligned=reduction[POSITION_ALIGNED],
    )


def _judge_figure_5(words: Wording, results: Results) -> tuple[Verdict, ...]:
    nearest = results.candidates[0]
    other = next(c for c in results.candidates if c.reading == VARIANCE)
    literal = next(c for c in results.candidates if c.truth == "all 42" and c.frame == "absolute")
    texts = [[f"{a:.0f} %" for a in c.reductions] for c in (nearest, other, literal)]
    return (
        words.judge(
            "variances",
            agrees=None if nearest.reading == VARIANCE else False,
            nearest=nearest,
            deviations=texts[0],
            variances=texts[1],
            given=NOISE,
            root=np.sqrt(NOISE),
        ),
        words.judge(
            "figure_5", absolute=literal.distance, literal=texts[2], distance=nearest.distance
        ),
    )


def _judge_points(words: Wording, results: Results) -> tuple[Verdict, ...]:
    ten, one, free = (_find_arrangement(results, name) for name in (TEN, ONE, ANY))
    cost_ten, cost_one = (a.cell.compute_median(LS)[POSITION_ALIGNED] for a in (ten, one))
    return (
        words.judge("exchange", ten=ten, one=one),
        words.judge(
            "one_plane",
            agrees=cost_one < 1.5 * cost_ten,
            one=one,
            ten=ten,
            free=free,
            noise=NOISE,
            cost_one=cost_one,
            cost_ten=cost_ten,
        ),
    )


def _judge_fifty(words: Wording, results: Results) -> tuple[Verdict, ...]:
    one, five = results.fifties
    factors = five.compute_factors(PRIOR, ABSOLUTE)[: len(STATISTICS)]
    return (
        words.judge(
            "iterations",
            one=one.within_five,
            five=five.within_five,
            most=[int(f.iterations.max()) for f in results.fifties],
        ),
        words.judge(
            "full_poses",
            agrees=None,
            ls_one=_format_change(one, ABSOLUTE),
            ls_five=_format_change(five, ABSOLUTE),
            nominal_one=_format_change(one, AT_NOMINAL),
            nominal_five=_format_change(five, AT_NOMINAL),
            aligned_one=_format_change(one, ALIGNED),
            aligned_five=_format_change(five, ALIGNED),
            prior_one=_format_change(one, ALIGNED, PRIOR),
            prior_five=_format_change(five, ALIGNED, PRIOR),
            factors=", ".join(f"{f:.1f}" for f in factors),
            stated=", ".join(given.stated for given in results.printed.table_4.values()),
        ),
    )


def _judge_arithmetic(words: Wording) -> tuple[Verdict, ...]:
    verdicts = []
    for name, given in read_published().table_4.items():
        low, high = given.possible
        verdicts.append(
            words.judge("factor", agrees=given.follows, name=name, given=given, low=low, high=high)
        )
    return (*verdicts, words.judge("conclusion", agrees=False))


def _judge_prior(words: Wording, results: Results) -> Verdict:
    cells = results.cells
    medians = {
        key: [c.compute_median(m)[POSITION_ALIGNED] for m in (BEFORE, LS, PRIOR)]
        for key, c in cells.items()
    }
    better = [key for key, (_, ls, prior) in medians.items() if prior <= (1.0 + SURE) * ls]
    harmed = [key for key, (before, _, prior) in medians.items() if prior > before]
    hardest = cells["0.01", "0.1"]
    before, ls, prior = medians["0.01", "0.1"]
    return words.judge(
        "prior",
        harmed=len(harmed),
        sure=100 * SURE,
        better=len(better),
        count=len(cells),
        before=before,
        ls=ls,
        map=prior,
        worse=hardest.count_worse(PRIOR, POSITION_ALIGNED),
        trials=len(hardest.iterations),
    )


def _judge_weights(words: Wording, results: Results) -> Verdict:
    position = {n: c.compute_median(LS)[POSITION_ALIGNED] for n, c in results.weights.items()}
    parameters = {
        n: c.compute_median(PRIOR)[PARAMETERS_WITHOUT_GAUGE] for n, c in results.weights.items()
    }
    return words.judge(
        "weights",
        limit=1.1 * position["full"],
        position=position,
        parameters=parameters,
        less={name: 100.0 * (1.0 - position["full"] / p) for name, p in position.items()},
        nearer=100.0 * (1.0 - position["distance"] / position["printed"]),
        set=SET,
        noise=NOISE,
    )


def _judge_forms(words: Wording, results: Results) -> Verdict:
    forms = results.forms
    largest = max(row[3] for row in forms.rows)
    quietest = min(row[0] for row in forms.rows)
    return words.judge(
        "forms",
        largest=largest,
        noise=max(row[0] for row in forms.rows),
        small=max(row[3] for row in forms.rows if row[0] == quietest),
        covariance=forms.covariance,
    )


def _find_arrangement(results: Results, name: str) -> Arrangement:
    return next(a for a in results.arrangements if a.name == name)


def _format_change(fifty: FiftyPoints, frame: str, method: str = LS) -> str:
    """Return the mean position error before and after, as text."""
    before, after = (fifty.compute_median(m, frame)[0] for m in (BEFORE, method))
    return f"{before:.2g} to {after:.2g} mm"
