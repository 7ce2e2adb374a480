# SPDX-License-Identifier: Apache-2.0
"""Write how fast the engines are into README.md and docs/engines.md, from the committed benchmarks.

Run as `python -m tools.speed_tables`. A block of a page names a table: README's compares with what
users write by hand, `ratios` has every ratio of `benchmarks/bench_engine.py`.
"""

import re
from pathlib import Path

from benchmarks.harness import read_baseline
from tools.markdown import fill_blocks, format_table

ROOT = Path(__file__).resolve().parent.parent
BASELINE = ROOT / "benchmarks" / "baseline.json"
PAGES = ("README.md", "docs/engines.md")
BLOCK = r"speed: (?P<name>[\w-]+)"
ENGINES = {"numpy": "NumPy engine", "native": "native engine"}

BY_HAND = {
    "forward_of_fsolve": "forward kinematics of 1,000 poses, against a loop over scipy's `fsolve`",
    "one_fit": "one fit with intervals, rank and checks, against scipy's `least_squares` alone "
    "with a Jacobian written by hand",
}
"""Works that README compares with programs of users."""

WORKS = {
    "inverse": (
        "inverse kinematics, 10,000 poses",
        "`np.linalg.solve` of 10,000 6 x 6 systems",
        "3 / 0.25",
    ),
    "forward": ("forward kinematics, 10,000 poses", "as above", "5 / 0.8"),
    "sensitivity": ("sensitivities of a U-P-S hexapod, 10,000 poses", "as above", "25 / 4"),
    "stacked_fits": (
        "fits of 42 parameters, 50 poses, many at once",
        "`np.linalg.qr` of the rows",
        "10 / 1.5",
    ),
    "chord_fits": ("these with the chord start of studies", "as above", "10 / 1.5"),
    "one_fit": ("one such fit with all its results", "`least_squares` written by hand", "5 / 1.5"),
    "many_poses": ("one fit of 100,000 poses", "`np.linalg.qr` of 600,000 x 43 rows", ""),
    "delta": ("a delta of 9 parameters, 30 poses", "1,000 times `np.linalg.solve` of 6 x 6", ""),
    "command": ("a calibration by the command line", "Python that imports numpy", "6 / 5"),
    "forward_of_fsolve": ("forward kinematics, 1,000 poses", "a loop over scipy's `fsolve`", ""),
}
"""What a benchmark measures, against what, and what was aimed at with each engine."""


def describe_ratio(ratio: float) -> str:
    """Return a ratio of times as a person says it."""
    factor, word = (1.0 / ratio, "faster") if ratio < 1.0 else (ratio, "slower")
    return f"{float(f'{factor:.2g}'):g} times {word}"


def build_table(name: str, ratios: dict[str, float]) -> str:
    """Return a table as Markdown; a ratio that the baseline lacks is a dash.

    Parameters
    ----------
    name : `by-hand` or `ratios`. ratios : metrics `engine.ENGINE.WORK` of the baseline.
    """
    if name == "by-hand":
        head, works = ["hexapod of 42 parameters, one thread"], [[w] for w in BY_HAND.values()]
        show, keys = describe_ratio, list(BY_HAND)
    else:
        head, works = ["work", "reference", "goal"], [list(words) for words in WORKS.values()]
        show, keys = "{:.2g}".format, list(WORKS)
    rows = []
    for key, words in zip(keys, works, strict=True):
        found = [ratios.get(f"engine.{engine}.{key}") for engine in ENGINES]
        rows.append([*words, *("-" if ratio is None else show(ratio) for ratio in found)])
    return format_table([*head, *ENGINES.values()], rows)


def find_outdated(root: Path = ROOT) -> dict[Path, str]:
    """Return the pages whose tables are not those of the baseline, with the text they should
    have.
    """
    ratios = {name: metric["value"] for name, metric in read_baseline(BASELINE).items()}

    def write(match: re.Match[str]) -> str:
        return build_table(match["name"], ratios)

    pages = {root / page: (root / page).read_text("utf-8") for page in PAGES}
    filled = {page: fill_blocks(text, BLOCK, write) for page, text in pages.items()}
    return {page: text for page, text in filled.items() if text != pages[page]}


def main() -> None:
    """Write the tables."""
    for page, text in find_outdated().items():
        page.write_text(text, encoding="utf-8")
        print(f"speed tables: wrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
