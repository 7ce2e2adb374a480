# SPDX-License-Identifier: Apache-2.0
"""Degenerate data: perfect, identical, a single pose, extreme sigmas. No sentence, page or file
contains nan or inf, and nothing warns.
"""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.validation import ErrorChange
from loopcal.cli.entry_point import main
from loopcal.findings.wording import fill_template
from loopcal.report.validation_view import _compare

NOT_FINITE = re.compile(r"(?<![\w.])[-+]?(nan|inf|infinity)(?!\w)", re.IGNORECASE)
HEADER = "pose,q1 [mm],q2 [mm],q3 [mm],x [mm],y [mm],z [mm]\n"


def write_data(path: Path, rows: list[int], noise: str, error: float) -> None:
    """Write positions of a linear delta at some of twenty poses, with errors [m]."""
    solution = lc.sample_workspace(lc.load_robot("linear-delta"), 20, seed=2).solution
    rng = np.random.default_rng(0)
    text = "# kind: component\n# components: [x, y, z]\n"
    text += f"# noise: {{x: {noise}, y: {noise}, z: {noise}}}\n" + HEADER
    for i, row in enumerate(rows):
        position = solution.T[row, :3, 3] + error * rng.standard_normal(3)
        numbers = (*solution.q[row], *position)
        text += ",".join([f"p{i}", *(repr(float(1e3 * v)) for v in numbers)]) + "\n"
    path.write_text(text)


STAGE = """format: 1
family: linear-delta
name: stage
source: ours, a linear delta a thousand million times smaller
units: {length: nm, angle: deg}
radius: 0.105
angles: [210, 330, 90]
arms: 0.22
stops: 0.3
readings: drop
stroke: [0, 0.4]
home: {z: 0.12}
workspace: {x: [-0.06, 0.06], y: [-0.06, 0.06], z: [0, 0.25]}
tolerances: {radius: {sd: 5e-4}, angles: {sd: 0.3}, arms: {sd: 3e-4}, stops: {sd: 5e-4}}
"""


def test_machine_of_picometers_is_calibrated(loopcal) -> None:
    """All of its poses were one block, which could not be split."""
    Path("stage.yaml").write_text(STAGE)
    loopcal("simulate stage.yaml -o d.csv --seed 1 --kind position --sigma-position 1e-5nm")
    loopcal("calibrate stage.yaml d.csv -o run --hold-out 0.25", "arm3.length")


CASES = {
    "perfect": (list(range(20)), "10 um", 0.0),
    "one": ([0], "10 um", 1e-5),
    "same": ([0] * 12, "10 um", 0.0),
    "tiny": (list(range(20)), "1e-6 nm", 1e-5),
    "huge": (list(range(20)), "1e8 m", 1e-5),
}
METHODS = ("map", "ls", "ridge", "tsvd", "map --noise estimated", "map --hold-out 0.1")
DEFAULT = {"perfect": METHODS[::2], "one": METHODS[1::2]}
"""Each method once where all are not tried; the rest of the commands read the last run."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "methods"),
    [
        *((case, DEFAULT.get(case, METHODS[:1])) for case in CASES),
        *(pytest.param(case, METHODS, marks=pytest.mark.evidence) for case in DEFAULT),
    ],
)
def test_no_command_shows_or_writes_what_is_not_finite(
    case, methods, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_data(Path("data.csv"), *CASES[case])
    write_data(Path("other.csv"), [3, 4], "10 um", 0.0)
    Path("targets.csv").write_text("x [mm],y [mm],z [mm]\n10,20,30\n0,0,360\n0,0,9e5\n")
    for method in methods:
        words = f"calibrate linear-delta data.csv -o run --force --method {method}"
        check_output(words, capsys)
    for words in (
        "validate run other.csv",
        "validate run data.csv --allow-fitted-data --json",
        "budget run",
        "compensate run targets.csv -o q.csv --force",
        "identifiability linear-delta data.csv",
        "sample run --region",
    ):
        check_output(words, capsys)
    for path in [*tmp_path.glob("run/*.yaml"), *tmp_path.glob("run/*.json"), *tmp_path.glob("q*")]:
        assert not NOT_FINITE.search(path.read_text()), path


def check_output(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Run a command; its output and errors contain only finite numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert main(words.split()) in (0, 1, 2)
    shown = "\n".join(capsys.readouterr())
    shown = re.sub(r"/\S+", "", shown)  # paths
    assert not NOT_FINITE.search(shown), NOT_FINITE.findall(shown)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (1e-3, 0.0, "zero after calibration"),
        (0.0, 0.0, "within the noise"),
        (1e-3, np.nan, "not known after calibration"),
        (np.nan, 1e-3, "not known before calibration"),
        (0.0, 1e-3, "larger after calibration"),
        (1e-3, 1e-320, "zero after calibration"),
    ],
)
def test_changes_that_have_no_factor_have_words(before: float, after: float, words: str) -> None:
    text = _compare(ErrorChange(before, after, 0.0, 12))
    assert words in text
    assert not NOT_FINITE.search(text)


@pytest.mark.parametrize("template", ["{x}", "{x:.3g}", "{x:factor}", "{x:percent}", "{x:.0f} mm"])
def test_numbers_that_are_not_finite_become_words(template: str) -> None:
    assert "unbounded" in fill_template(template, x=np.inf)
    assert "unbounded" in fill_template(template, x=-np.inf)
    assert "unknown" in fill_template(template, x=float("nan"))
