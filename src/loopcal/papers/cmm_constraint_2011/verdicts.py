# SPDX-License-Identifier: Apache-2.0
"""Judge every claim of the paper, and our own checks, by the numbers of this run."""

from __future__ import annotations

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
from loopcal.papers.cmm_constraint_2011.layouts import ANY, NOISE, ONE, SET, TEN, VARIANCE
from loopcal.papers.cmm_constraint_2011.machines import (
    ABSOLUTE,
    ALIGNED,
    AT_NOMINAL,
    MEASURES,
    list_gauge_directions,
)
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
        *_judge_equations(words, results),
        *_judge_table_3(words, results),
        *_judge_figure_5(words, results),
        *_judge_points(words, results),
        *_judge_fifty(words, results),
        *_judge_arithmetic(words),
        *_judge_methods(words, results),
    )


def _judge_equations(words: Wording, results: Results) -> tuple[Verdict, ...]:
    rows = results.study.optimized.rows.reshape(-1, 42)
    moved = rows @ list_gauge_directions(results.study.robot)[:6].T
    points, rank = compute_pair_rank(results.study)
    ranks, groups = sorted({r.rank for r in results.ranks}), [r.groups for r in results.ranks]
    unused = [r.singular_values[r.rank] / r.singular_values[0] for r in results.ranks]
    counted = None if rank == points - 2 else rank == points - 1
    return (
        words.judge("independent", effect=np.abs(moved).max() / np.abs(rows).max()),
        words.judge("counted", agrees=counted, points=points, rank=rank),
        words.judge(
            "least_squares", agrees=ranks == [42], ranks=ranks, fewest=min(groups),
            most=max(groups), largest=max(unused),
        ),
    )  # fmt: skip


def _judge_table_3(words: Wording, results: Results) -> tuple[Verdict, ...]:
    from scipy.stats import beta

    quiet, cells = results.cells["1", "0.0001"], results.cells
    share = quiet.errors[LS][:, PARAMETERS] / quiet.errors[BEFORE][:, PARAMETERS]
    medians = {
        m: {k: c.compute_median(m)[POSITION_ALIGNED] for k, c in cells.items()}
        for m in (BEFORE, LS)
    }
    worse = [key for key in cells if medians[LS][key] > medians[BEFORE][key]]
    ratios = [medians[LS][key] * MM / c.noise for key, c in cells.items()]
    ranks = {method: compute_rank_correlation(cells.values(), method) for method in METHODS}
    reduction = cells["1", "0.01"].compute_reduction(LS)
    return (
        words.judge(
            "three_quarters", agrees=np.mean(share) <= 0.25, noise=quiet.noise / MM,
            chance=100.0 * float(beta.cdf(0.25**2, 4.5, 16.5)), mean=100.0 * (1.0 - share.mean()),
            reached=int((share <= 0.25).sum()), count=len(share),
        ),
        words.judge(
            "better", ratio=np.median(ratios), better=len(cells) - len(worse), count=len(cells),
            worse=", ".join(f"errors {s} mm with noise {n} mm" for s, n in worse) or "none",
        ),
        words.judge(
            "correlation", count=len(cells), ratios=len({c.ratio for c in cells.values()}),
            ranks=ranks, parameters=reduction[PARAMETERS], position=reduction[POSITION],
            aligned=reduction[POSITION_ALIGNED],
        ),
    )  # fmt: skip


def _judge_figure_5(words: Wording, results: Results) -> tuple[Verdict, ...]:
    nearest = results.candidates[0]
    other = next(c for c in results.candidates if c.reading == VARIANCE)
    literal = next(c for c in results.candidates if c.truth == "all 42" and c.frame == "absolute")
    texts = [[f"{a:.0f} %" for a in c.reductions] for c in (nearest, other, literal)]
    return (
        words.judge(
            "variances", agrees=None if nearest.reading == VARIANCE else False, nearest=nearest,
            deviations=texts[0], variances=texts[1], given=NOISE, root=np.sqrt(NOISE),
        ),
        words.judge("figure_5", literal=literal, reductions=texts[2], distance=nearest.distance),
    )  # fmt: skip


def _judge_points(words: Wording, results: Results) -> tuple[Verdict, ...]:
    ten, one, free = (
        next(a for a in results.arrangements if a.name == name) for name in (TEN, ONE, ANY)
    )
    cost_ten, cost_one = (a.cell.compute_median(LS)[POSITION_ALIGNED] for a in (ten, one))
    return (
        words.judge("exchange", ten=ten, one=one),
        words.judge(
            "one_plane", one=one, ten=ten, free=free, noise=NOISE, cost_one=cost_one,
            cost_ten=cost_ten, limit=1.5 * cost_ten,
        ),
    )  # fmt: skip


def _judge_fifty(words: Wording, results: Results) -> tuple[Verdict, ...]:
    one, five = results.fifties
    factors = five.compute_factors(PRIOR, ABSOLUTE)[: len(STATISTICS)]
    frames = {
        "ls": (ABSOLUTE, LS),
        "nominal": (AT_NOMINAL, LS),
        "aligned": (ALIGNED, LS),
        "prior": (ALIGNED, PRIOR),
    }
    changes = {
        name: [_format_change(fifty, *how) for fifty in (one, five)] for name, how in frames.items()
    }
    return (
        words.judge("iterations", one=one, five=five),
        words.judge(
            "full_poses", agrees=None, factors=", ".join(f"{f:.1f}" for f in factors),
            stated=", ".join(given.stated for given in results.printed.table_4.values()), **changes,
        ),
    )  # fmt: skip


def _judge_arithmetic(words: Wording) -> tuple[Verdict, ...]:
    table = read_published().table_4
    factors = [
        words.judge("factor", agrees=given.follows, name=name, given=given)
        for name, given in table.items()
    ]
    return (*factors, words.judge("conclusion", agrees=False))


def _judge_methods(words: Wording, results: Results) -> tuple[Verdict, ...]:
    """Judge the prior, the weights of the rows, and the two forms of the equations."""
    medians = {
        key: [c.compute_median(m)[POSITION_ALIGNED] for m in (BEFORE, LS, PRIOR)]
        for key, c in results.cells.items()
    }
    better = [key for key, (_, ls, prior) in medians.items() if prior <= (1.0 + SURE) * ls]
    harmed = [key for key, (before, _, prior) in medians.items() if prior > before]
    hardest = results.cells["0.01", "0.1"]
    position = {n: c.compute_median(LS)[POSITION_ALIGNED] for n, c in results.weights.items()}
    parameters = {
        n: c.compute_median(PRIOR)[PARAMETERS_WITHOUT_GAUGE] for n, c in results.weights.items()
    }
    forms = results.forms
    largest, noises = [row[3] for row in forms.rows], [row[0] for row in forms.rows]
    return (
        words.judge(
            "prior", sure=100 * SURE, better=len(better), harmed=len(harmed), count=len(medians),
            medians=medians["0.01", "0.1"], worse=hardest.count_worse(PRIOR, POSITION_ALIGNED),
            trials=len(hardest.iterations),
        ),
        words.judge(
            "weights", position=position, parameters=parameters, set=SET, noise=NOISE,
            limit=1.1 * position["full"],
            less={name: 100.0 * (1.0 - position["full"] / p) for name, p in position.items()},
            nearer=100.0 * (1.0 - position["distance"] / position["printed"]),
        ),
        words.judge(
            "forms", largest=max(largest), noise=max(noises), covariance=forms.covariance,
            small=max(row[3] for row in forms.rows if row[0] == min(noises)),
        ),
    )  # fmt: skip


def _format_change(fifty: FiftyPoints, frame: str, method: str) -> str:
    """Return the mean position error before and after, as text."""
    before, after = (fifty.compute_median(m, frame)[0] for m in (BEFORE, method))
    return f"{before:.2g} to {after:.2g} mm"
