# SPDX-License-Identifier: Apache-2.0
"""`loopcal validate` recognizes fitted rows in another file and refuses them."""

import shutil
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"


def test_validate_refuses_fitted_rows_in_another_file_and_accepts_held_out_ones(loopcal) -> None:
    shutil.copy(EXAMPLE / "measurements.csv", "all.csv")
    lines = Path("all.csv").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("pose,")) + 1
    head, rows = lines[:first], lines[first:]
    Path("fit.csv").write_text("\n".join(head + rows[:30]) + "\n")
    Path("part.csv").write_text("\n".join(["## a copy", *head, *rows[7::-1]]) + "\n")
    Path("mixed.csv").write_text("\n".join(head + rows[28:]) + "\n")
    Path("rest.csv").write_text("\n".join(head + rows[30:]) + "\n")
    loopcal("calibrate hexapod-42 fit.csv -o run")
    _, out, err = loopcal("validate run part.csv", code=1)
    assert out == ""
    assert "The calibration used 8 of 8 rows (poses " in err
    assert "--allow-fitted-data" in err
    loopcal("validate run part.csv --allow-fitted-data")
    assert loopcal("validate run rest.csv").err == ""
    assert loopcal("validate run mixed.csv").err.startswith(
        "loopcal: note: The calibration used 2 of 12 rows"
    )


@pytest.mark.slow
def test_prior_refuses_fitted_rows_whatever_their_file_looks_like(loopcal, capsys) -> None:
    """A blank line, another order and unit, a subset, a superset, two files of which one is old,
    and rows of the prior's own prior.
    """
    lines = (EXAMPLE / "measurements.csv").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("pose,")) + 1
    head, rows = lines[:first], lines[first:]

    def write(name: str, chosen: list[str], header: list[str] = head) -> str:
        Path(name).write_text("\n".join([*header, *chosen]) + "\n")
        return name

    def convert(line: str) -> str:
        return ",".join(
            repr(float(field) * 1e-3) if i in in_mm else field
            for i, field in enumerate(line.split(","))
        )

    columns = head[-1].split(",")
    in_mm = [i for i, name in enumerate(columns) if name.endswith("[mm]")]
    assert in_mm
    meters = [*head[:-1], head[-1].replace("[mm]", "[m]")]
    old, new, third = rows[:20], rows[20:30], rows[30:]
    write("old.csv", old)
    write("new.csv", new)
    write("third.csv", third)
    copies = {
        "blank.csv": ["", *old],
        "order.csv": old[::-1],
        "subset.csv": old[5:8],
        "superset.csv": [*old, *new],
    }
    files = [[write(name, chosen)] for name, chosen in copies.items()]
    files.append([write("meters.csv", [convert(line) for line in old], meters)])
    files.append(["new.csv", "old.csv"])
    loopcal("calibrate hexapod-42 old.csv -o run")
    for names in files:
        capsys.readouterr()
        err = loopcal(
            ["calibrate", "hexapod-42", *names, "-o", "run2", "--prior", "run"], code=1
        ).err
        assert ": The earlier calibration already contains " in err, (names, err)
        is_partly_new = names in (["superset.csv"], ["new.csv", "old.csv"])
        assert ("--drop POSE" in err) == is_partly_new  # else nothing would be left
    loopcal("calibrate hexapod-42 new.csv -o run2 --prior run")
    for name in ("subset.csv", "new.csv"):  # of the prior of the prior, and of the prior
        loopcal(
            ["calibrate", "hexapod-42", name, "-o", "run3", "--prior", "run2"],
            "count twice",
            code=1,
        )
        loopcal(["validate", "run2", name], "The calibration used", code=1)
    loopcal("calibrate hexapod-42 third.csv -o run3 --prior run2")
