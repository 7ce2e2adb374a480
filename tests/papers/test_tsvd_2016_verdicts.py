# SPDX-License-Identifier: Apache-2.0
"""Verdicts of tsvd-2016 follow from numbers: on random results each says "does not agree"."""

from dataclasses import replace

import numpy as np

from loopcal.papers.printed import Printed
from loopcal.papers.tsvd_2016.draws import BEFORE, METHODS, Draws
from loopcal.papers.tsvd_2016.published import read_published
from loopcal.papers.tsvd_2016.situations import LAMBDAS, LS, RANKED, RE, TSVD, Chosen, Situation
from loopcal.papers.tsvd_2016.tables import Results
from loopcal.papers.tsvd_2016.verdicts import judge_claims


def draw_random_results(rng: np.random.Generator, machines: int = 2) -> Results:
    """Return results of the right shapes whose numbers are random."""

    def draw_errors(*shape: int, lost: float = 0.1) -> np.ndarray:
        size = np.exp(rng.normal(0.0, 1.0))  # of all errors of a method
        errors = size * np.exp(rng.normal(0.0, 1.0, (machines, *shape, 5)))
        errors[..., 4] = rng.uniform(-0.2, 1.0, errors.shape[:-1]).clip(0.0)
        return np.where(rng.random((machines, *shape, 1)) < lost, np.inf, errors)

    def draw_situation(name: str, freedoms: int) -> Situation:
        p = 33 if name == "3-PRS" else 25
        ks = np.arange(p, p // 3, -1)
        chosen = {
            algorithm: Chosen(
                rng.choice(LAMBDAS, machines) if algorithm == RE else rng.choice(ks, machines),
                rng.integers(1, 60, machines),
                draw_errors(),
                draw_errors()[:, :2],
            )
            for algorithm in (LS, RANKED, RE, TSVD)
        }
        sweeps = (draw_errors(len(LAMBDAS)), draw_errors(len(ks)), draw_errors(len(LAMBDAS)))
        exact = draw_errors() * 10.0 ** rng.uniform(-6.0, 0.0)
        return Situation(name, freedoms, LAMBDAS, ks, *sweeps, chosen, exact)

    draws = tuple(
        Draws(
            name,
            draw_situation(name, 6),
            draw_situation(name, 5),
            {method: draw_errors(lost=0.1 * (method != BEFORE)) for method in METHODS},
            {method: draw_errors()[:, :2] for method in METHODS},
        )
        for name in ("RU-PUS-PRS", "3-PRS")
    )
    printed = read_published()
    noise = {row: tuple(f"{x:.6f}" for x in rng.normal(0.0, 0.01, 6)) for row in printed.noise.rows}
    steps = [(5, 0.1, np.ones(5)), ("at convergence", 1.0, np.ones(5))]
    published = replace(printed, noise=Printed(noise))
    return Results(published, (), draws, steps, None)  # type: ignore[arg-type]


def test_every_verdict_says_does_not_agree_on_random_results() -> None:
    waiting: set[str] = set()
    for seed in range(100):
        verdicts = judge_claims(draw_random_results(np.random.default_rng(seed)))
        names = [f"{i} {verdict.name}" for i, verdict in enumerate(verdicts)]
        assert all("nan" not in verdict.why for verdict in verdicts)
        waiting = (waiting if seed else set(names)) - {
            name for name, verdict in zip(names, verdicts, strict=True) if verdict.agrees is False
        }
        if not waiting:
            break
    assert waiting == set()
