# SPDX-License-Identifier: Apache-2.0
"""`loopcal identifiability`: sentences, tables, the smaller robot file, JSON, and options that
contradict each other.
"""

import json

import pytest

from loopcal.cli import main
from loopcal.io import load_robot


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run the command in an empty folder; return exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def run(words: str) -> tuple[int, str, str]:
        code = main(["identifiability", *words.split()])
        return code, *capsys.readouterr()

    return run


def test_five_of_six_coordinates_of_the_3_prs(run):
    code, out, err = run("3-prs --measure x,y,z,phi,theta")
    assert (code, err) == (0, "")
    assert "determine 32 of 33 parameter combinations" in out
    document = json.loads(run("3-prs --measure x,y,z,phi,theta --json")[1])
    (open_,) = document["unidentifiable"]
    assert set(open_["names"]) == {"a1y", "a2y", "a3y"}
    assert document["remedies"][0]["cures"][0]["words"] == "psi"
    states = {row["name"]: row["state"] for row in document["parameters"]}
    assert states["a2y"] == "together"
    assert [line.split()[0] for line in out.splitlines() if line.startswith("O")][-1] == "O5"


def test_five_of_six_coordinates_of_the_tracker(run):
    document = json.loads(run("ru-pus-prs --measure x,y,z,phi,theta --json")[1])
    assert (document["rank"], document["n_parameters"]) == (24, 25)


@pytest.mark.parametrize(("frames", "rank"), [("base", 36), ("tool", 36), ("base,tool", 30)])
def test_unknown_frames_of_the_hexapod(run, frames, rank):
    assert json.loads(run(f"hexapod-42 --frames {frames} --json")[1])["rank"] == rank


def test_the_reduced_file_is_written_and_whole(run, tmp_path):
    code, out, _ = run("hexapod-42 --frames base --reduce -o smaller.yaml")
    assert code == 0
    assert "36 of 42 parameters contain all information" in out
    assert out.count("Fix leg") == 6
    assert load_robot(tmp_path / "smaller.yaml").parameters.free.sum() == 36
    assert json.loads(run("smaller.yaml --frames base --json")[1])["rank"] == 36
    assert "this file exists" in run("hexapod-42 --frames base --reduce -o smaller.yaml")[2]
    assert run("hexapod-42 --frames base --reduce -o smaller.yaml --force")[0] == 0


def test_the_json_holds_all_of_it(run):
    document = json.loads(run("3-prs --measure x,y,z,phi,theta --reduce --json")[1])
    assert sorted(document["unidentifiable"][0]["names"]) == ["a1y", "a2y", "a3y"]
    assert document["remedies"][0]["cures"][0]["words"] == "psi"
    assert document["reduction"]["dropped"][0]["name"] == "a3y"
    assert set(document["indices"]) >= {"o1", "o2", "o3", "o4", "o5", "scaling"}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "3-prs --measure x,y --components z",
            "--measure is short for --kind component --components",
        ),
        ("3-prs --measure x,y,w", "the component 'w'"),
        (
            "3-prs --frames floor",
            "'floor' is not a frame that can be unknown; allowed are base, tool",
        ),
        ("3-prs --kind inclination --frames base", "this kind of measurement has no base frame"),
        ("3-prs data.csv --measure x", "DATA states what is measured"),
        ("3-prs -o smaller.yaml", "-o writes the robot of --reduce"),
    ],
)
def test_options_that_contradict_each_other_are_one_sentence(run, words, sentence):
    code, out, err = run(words)
    assert (code, out) == (1, "")
    assert sentence in err
    assert err.count("\n") == 1


def test_noisy_encoders_are_assumed_for_an_instrument_and_weaken_what_is_known(run):
    """Readings of 1 mm beside positions of 10 um: every parameter is known worse, and none better."""  # noqa: E501
    words = "linear-delta --draw 20 --kind position --json"
    exact, noisy = (
        json.loads(run(words + more)[1])["singular_values"] for more in ("", " --sigma-reading 1mm")
    )
    assert max(noisy) < 0.1 * max(exact)
    assert (
        run("linear-delta --draw 20 --kind position --json --sigma-reading q1=1mm,q2=1mm,q3=1mm")[1]
        == run(words + " --sigma-reading 1mm")[1]
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--sigma-reading 5", "--sigma-reading '5' for q1: '5' has no unit"),
        ("--sigma-reading 5urad", "'urad' is a unit of angle, but a length is needed"),
        (
            "--sigma-reading -5um",
            "--sigma-reading for q1 is -5um; give a number above zero, or zero for exact",
        ),
        ("--sigma-reading q9=5um", "--sigma-reading names 'q9'"),
        ("--sigma-reading q1=5um,q2", "--sigma-reading 'q2' for q1: "),
    ],
)
def test_a_noise_of_readings_without_sense_is_one_sentence(run, words, sentence):
    code, out, err = run(f"linear-delta --draw 5 {words}")
    assert (code, out) == (1, "")
    assert sentence in err
    assert err.count("\n") == 1
