# SPDX-License-Identifier: Apache-2.0
"""Judge every claim of the paper, and our own checks, by the numbers of this run."""

from __future__ import annotations

from typing import Any

import numpy as np

from loopcal.papers.cmm_constraint_2011.calibrations import (
    BEFORE,
    LS,
    METHODS,
    PRIOR,
    STATISTICS,
    FiftyPoints,
    compute_rank_correlation,
)
from loopcal.papers.cmm_constraint_2011.draws import Draw
from loopcal.papers.cmm_constraint_2011.layouts import ANY, NOISE, ONE, SD, SET, TEN, VARIANCE
from loopcal.papers.cmm_constraint_2011.machines import (
    ABSOLUTE,
    ALIGNED,
    AT_NOMINAL,
    FRAMES,
    MEASURES,
)
from loopcal.papers.cmm_constraint_2011.published import MM, Published, compute_excess
from loopcal.papers.cmm_constraint_2011.tables import Results
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
        *_judge_equations(words, results),
        *_judge_table_3(words, results),
        *_judge_figure_5(words, results),
        *_judge_points(words, results),
        *_judge_fifty(words, results),
        *_judge_arithmetic(words, results.printed),
        *_judge_methods(words, results),
    )


def _judge_equations(words: Wording, results: Results) -> tuple[Verdict, ...]:
    points, rank = results.pair
    ranks, groups = sorted({r.rank for r in results.ranks}), [r.groups for r in results.ranks]
    unused = [r.unused for r in results.ranks]
    return (
        words.judge("independent", effect=results.gauge_effects[:6].max()),
        words.judge("counted", points=points, rank=rank, missing=points - rank),
        words.judge(
            "least_squares", least=ranks[0], parameters=results.printed.parameters, ranks=ranks,
            fewest=min(groups), most=max(groups), largest=max(unused),
        ),
    )  # fmt: skip


def _judge_table_3(words: Wording, results: Results) -> tuple[Verdict, ...]:
    from scipy.stats import beta

    draws, cells = results.draws, results.cells
    shares = [_list_shares(draw) for draw in draws]
    better = [_compare_with_before(draw) for draw in draws]
    ranks = [{m: compute_rank_correlation(d.cells.values(), m) for m in METHODS} for d in draws]
    reduction = cells["1", "0.01"].compute_reduction(LS)
    return (
        words.judge(
            "three_quarters", draws=shares, noise=cells["1", "0.0001"].noise / MM,
            chance=100.0 * float(beta.cdf(0.25**2, 4.5, 16.5)), **shares[0],
        ),
        words.judge("better", draws=better, count=len(cells), **better[0]),
        words.judge(
            "correlation", draws=[{"ranks": r} for r in ranks], count=len(cells),
            ratios=len({c.ratio for c in cells.values()}), ranks=ranks[0],
            least={m: min(r[m] for r in ranks) for m in METHODS},
            parameters=reduction[PARAMETERS], position=reduction[POSITION],
            aligned=reduction[POSITION_ALIGNED],
        ),
    )  # fmt: skip


def _list_shares(draw: Draw) -> dict[str, Any]:
    """Return by how much the norm of the parameter errors decreases with the least noise."""
    quiet = draw.cells["1", "0.0001"]
    left = (quiet.errors[LS] / quiet.errors[BEFORE])[quiet.converged[LS], PARAMETERS]
    reached = int((left <= 0.25).sum())
    mean = 100.0 * (1.0 - left.mean()) if len(left) else np.nan
    return {"mean": mean, "reached": reached, "count": len(left)}


def _compare_with_before(draw: Draw) -> dict[str, Any]:
    """Return in which cells least squares reduces the median position error."""
    after, before = (
        {k: c.compute_median(m)[POSITION_ALIGNED] for k, c in draw.cells.items()}
        for m in (LS, BEFORE)
    )
    worse = [k for k in after if not after[k] <= before[k]]
    texts = [f"errors {s} mm with noise {n} mm" for s, n in worse]
    ratio = np.median([after[k] * MM / c.noise for k, c in draw.cells.items()])
    return {"better": len(after) - len(worse), "worse": texts or ["none"], "ratio": ratio}


def _judge_figure_5(words: Wording, results: Results) -> tuple[Verdict, ...]:
    ranked = sorted(results.candidates, key=lambda candidate: candidate.distance)
    nearest = ranked[0]
    deviation, variance = (
        next(c for c in ranked if c.reading == reading) for reading in (SD, VARIANCE)
    )
    literal = next(c for c in ranked if c.truth == "all 42" and c.frame == "absolute")
    texts = [[f"{a:.0f} %" for a in c.reductions] for c in (deviation, variance, literal)]
    return (
        words.judge(
            "variances", deviation=deviation, variance=variance, deviations=texts[0],
            variances=texts[1], given=NOISE, root=np.sqrt(NOISE),
        ),
        words.judge("figure_5", literal=literal, reductions=texts[2], nearest=nearest),
    )  # fmt: skip


def _judge_points(words: Wording, results: Results) -> tuple[Verdict, ...]:
    ten_groups, one_group, any_axis = (
        next(a for a in results.arrangements if a.name == name) for name in (TEN, ONE, ANY)
    )
    cost_ten, cost_one = (
        a.cell.compute_median(LS)[POSITION_ALIGNED] for a in (ten_groups, one_group)
    )
    return (
        words.judge(
            "exchange", draws=[{"gain": draw.gain} for draw in results.draws],
            gain=results.draws[0].gain, least=min(draw.gain for draw in results.draws),
            ten=ten_groups, one=one_group,
        ),
        words.judge(
            "one_plane", one=one_group, ten=ten_groups, free=any_axis, noise=NOISE,
            cost_one=cost_one, cost_ten=cost_ten, limit=1.5 * cost_ten,
        ),
    )  # fmt: skip


def _judge_fifty(words: Wording, results: Results) -> tuple[Verdict, ...]:
    one_plane, five_planes = results.fifties
    factors = five_planes.compute_factors(PRIOR, ABSOLUTE)[: len(STATISTICS)]
    frames = {
        "ls": (ABSOLUTE, LS),
        "nominal": (AT_NOMINAL, LS),
        "aligned": (ALIGNED, LS),
        "prior": (ALIGNED, PRIOR),
    }
    changes: dict[str, Any] = {
        name: [_format_change(fifty, *how) for fifty in (one_plane, five_planes)]
        for name, how in frames.items()
    }
    falls = [
        bool((fifty.compute_factors(method, frame) > 1.0).all())
        for fifty in (one_plane, five_planes) for frame in FRAMES for method in METHODS
    ]  # fmt: skip
    within = [draw.fifties[0].within_five for draw in results.draws]
    return (
        words.judge(
            "iterations", draws=[{"within": share} for share in within], within=within[0],
            one=one_plane, five=five_planes, least=min(within), most=max(within),
        ),
        words.judge(
            "full_poses", falling=sum(falls), ways=len(falls),
            factors=", ".join(f"{f:.1f}" for f in factors),
            stated=", ".join(given.stated for given in results.printed.table_4.values()), **changes,
        ),
    )  # fmt: skip


def _judge_arithmetic(words: Wording, printed: Published) -> tuple[Verdict, ...]:
    factors = [
        words.judge("factor", name=name, given=given) for name, given in printed.table_4.items()
    ]
    possible = {name: printed.compute_rms_factors(name) for name in printed.conclusion}
    excess = [compute_excess(printed.conclusion[name], possible[name]) for name in possible]
    conclusion = words.judge(
        "conclusion", stated=printed.conclusion, possible=possible, excess=max(excess)
    )
    return (*factors, conclusion)


def _judge_methods(words: Wording, results: Results) -> tuple[Verdict, ...]:
    """Judge the prior, the weights of the rows, and the two forms of the equations."""
    priors = [_compare_prior(draw) for draw in results.draws]
    hardest, forms = results.cells["0.01", "0.1"], results.forms
    weights = [_compare_weights(draw) for draw in results.draws]
    parameters = {
        n: c.compute_median(PRIOR)[PARAMETERS_WITHOUT_GAUGE]
        for n, c in results.draws[0].weights.items()
    }
    noises = [row.noise / MM for row in forms.rows]
    medians: dict[str, Any] = {
        name: max(row.median for row in forms.rows if row.noise / MM == noise)
        for name, noise in (("loud", max(noises)), ("calm", min(noises)))
    }
    return (
        words.judge(
            "prior", draws=priors, sure=100 * SURE, count=len(results.cells),
            worse=hardest.count_worse(PRIOR, POSITION_ALIGNED), trials=len(hardest.iterations),
            **priors[0],
        ),
        words.judge(
            "weights", draws=weights, parameters=parameters, set=SET, noise=NOISE,
            lowest=min(w["less"]["printed"] for w in weights),
            highest=max(w["less"]["printed"] for w in weights), **weights[0],
        ),
        words.judge(
            "forms", covariance=forms.covariance, compared=sum(row.converged for row in forms.rows),
            largest=max((row.largest for row in forms.rows if row.converged), default=np.nan),
            fits=sum(row.machines for row in forms.rows), noise=max(noises), least=min(noises),
            **medians,
        ),
        words.judge(
            "converged", hardest=forms.hardest, noise=forms.hardest.noise / MM,
            converged=sum(row.converged for row in forms.others),
            fits=sum(row.machines for row in forms.others),
            most=max(row.iterations for row in forms.rows),
            ranks=sorted({rank for row in forms.rows for rank in row.ranks}),
            noises=[f"{noise:g}" for noise in sorted(set(noises))],
        ),
    )  # fmt: skip


def _compare_prior(draw: Draw) -> dict[str, Any]:
    """Return in how many cells MAP is not worse than least squares, and worse than before."""
    medians = {
        key: [c.compute_median(m)[POSITION_ALIGNED] for m in (BEFORE, LS, PRIOR)]
        for key, c in draw.cells.items()
    }
    better = [key for key, (_, ls, prior) in medians.items() if prior <= (1.0 + SURE) * ls]
    harmed = [key for key, (before, _, prior) in medians.items() if not prior <= before]
    return {"better": len(better), "harmed": len(harmed), "medians": medians["0.01", "0.1"]}


def _compare_weights(draw: Draw) -> dict[str, Any]:
    """Return the position errors of least squares with each weighting of the rows."""
    position = {n: c.compute_median(LS)[POSITION_ALIGNED] for n, c in draw.weights.items()}
    return {
        "position": position,
        "limit": (1.0 + SURE) * position["full"],
        "less": {name: 100.0 * (1.0 - position["full"] / p) for name, p in position.items()},
        "nearer": 100.0 * (1.0 - position["distance"] / position["printed"]),
    }


def _format_change(fifty: FiftyPoints, frame: str, method: str) -> str:
    """Return the mean position error before and after, as text."""
    before, after = (fifty.compute_median(m, frame)[0] for m in (BEFORE, method))
    return f"{before:.2g} to {after:.2g} mm"
