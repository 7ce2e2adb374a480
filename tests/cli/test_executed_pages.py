# SPDX-License-Identifier: Apache-2.0
"""Pages whose commands and Python code run from top to bottom, and print what the pages show.

The conventions of these pages: `tests/cli/page_commands.py`. Pages of studies run in
`test_question_pages.py`.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from tests.cli.page_commands import check_shown_lines, list_blocks, run_command, run_page

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = (
    "coming-from",
    "comparing-runs",
    "controllers",
    "delta-printers",
    "instruments",
    "machines",
    "robots",
    "self-calibration",
)


def read_page(name: str) -> str:
    return (DOCS / f"{name}.md").read_text("utf-8")


def read_estimates(run: str) -> dict[str, float]:
    """Return the estimates of a run by name, in the units of its robot file."""
    parameters = json.loads(Path(run, "result.json").read_text("utf-8"))["fit"]["parameters"]
    return {parameter["name"]: parameter["estimate"] for parameter in parameters}


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES)
def test_page_runs_and_prints_what_it_shows(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = read_page(name)
    run_page(page)
    shown = [block for block in list_blocks(page) if block.language == "text"]
    assert shown, "a page shows what its commands print"


@pytest.mark.parametrize("name", PAGES)
def test_text_above_a_file_names_it_for_the_reader(name) -> None:
    page = read_page(name)
    for comment in re.finditer(r"<!-- file: (\S+) -->", page):
        paragraph = page[: comment.start()].rstrip().split("\n\n")[-1]
        assert f"`{comment[1]}`" in paragraph


def test_rods_of_20_mm_stay_flat_and_are_off_center_as_the_page_states(
    tmp_path, monkeypatch
) -> None:
    """Check the sentences on 20 mm of docs/delta-printers.md."""
    monkeypatch.chdir(tmp_path)
    page = read_page("delta-printers")
    files = {block.file: block.text for block in list_blocks(page) if block.file}
    Path("seven.csv").write_text(files["seven.csv"])
    machine_text = files["wrong-rods.yaml"].replace("225", "240").replace("215", "200")
    Path("machine.yaml").write_text(machine_text)
    nominal_text = machine_text[: machine_text.index("identified:")]
    Path("firmware.yaml").write_text(nominal_text + "fixed: [arm*.length]\n")
    run_command(
        "loopcal simulate machine.yaml --poses seven.csv --kind component --components z "
        "--sigma-position 0.02mm -o heights.csv"
    )
    printed = run_command("loopcal calibrate firmware.yaml heights.csv -o run")
    largest = re.search(r"^position z +largest +7 +\S+ +(\S+)", printed, re.MULTILINE)
    assert largest
    assert float(largest[1]) < 0.04  # [mm]
    assert "Recommendation: Keep the current values" in printed
    firmware, machine = lc.load_robot("run/robot.yaml"), lc.load_robot("machine.yaml")
    targets = np.array([[0, 0, 0], [0.06, 0, 0], [0, 0.06, 0], [-0.06, 0, 0], [0, -0.06, 0]])
    nozzle = lc.forward(machine, lc.inverse(firmware, targets).q).T[:, :3, 3]
    shift = 1e3 * np.linalg.norm((nozzle - targets)[:, :2], axis=1)
    sentence = "the center is {:.0f} mm and the edge up to {:.0f} mm off"
    assert sentence.format(shift[0], shift.max()) in " ".join(page.split())


@pytest.mark.slow
def test_probed_heights_give_the_wrong_rods_of_the_page_and_a_flat_bed(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    row = re.compile(
        r"^\| (\w+) \| ([\d.]+) mm \| ([\d.]+) mm \| ([\d.]+) mm \| \S+ (\d+) mm \| (\S+) mm",
        re.MULTILINE,
    )
    rows = row.findall(read_page("delta-printers"))
    assert len(rows) == 3
    run_command("loopcal example delta-printer")
    for seed, (run, *arms, half, height) in zip((1, 2, 4), rows, strict=True):
        run_command(
            "loopcal simulate delta-printer/truth.yaml --poses delta-printer/points.csv --kind "
            f"component --components z --sigma-position 0.02mm --seed {seed} -o {run}.csv"
        )
        printed = run_command(
            f"loopcal calibrate linear-delta {run}.csv --method least-squares -o {run}"
        )
        estimates = read_estimates(run)
        assert [f"{estimates[f'arm{k}.length']:.1f}" for k in (1, 2, 3)] == arms
        assert (
            max(re.findall(r"^arm\d.length +\S+ +\S+ +(\d+) +mm$", printed, re.MULTILINE)) == half
        )
        assert re.search(rf"^position z +rms .* {height} +\S+ +mm$", printed, re.MULTILINE)


@pytest.mark.slow
def test_table_of_instruments_states_the_ranks_of_the_hexapod() -> None:
    rows = re.findall(r"\| `(\w+)`(?: \((\w)\))? \| (\d+) of 42 \|", read_page("instruments"))
    assert len(rows) == 8
    for kind, component, rank in rows:
        options = f"--kind {kind}" + (f" --components {component}" if component else "")
        command = f"loopcal identifiability hexapod-42 {options} --draw 40 --json"
        found = json.loads(run_command(command))
        assert (kind, found["rank"]) == (kind, int(rank))
        frames = [one["meaning"] for one in found["unidentifiable"]]
        assert all(frames), "what is not determined only moves a frame"


def test_line_that_was_not_printed_is_an_error() -> None:
    check_shown_lines("a  1 mm\n...\nb 2 mm", "a 1 mm\nother\nb  2 mm\n")
    with pytest.raises(AssertionError, match="b 3 mm"):
        check_shown_lines("a 1 mm\nb 3 mm", "a 1 mm\nb 2 mm\n")
    with pytest.raises(AssertionError, match="a 1 mm"):
        check_shown_lines("b 2 mm\na 1 mm", "a 1 mm\nb 2 mm\n")
