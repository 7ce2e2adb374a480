# SPDX-License-Identifier: Apache-2.0
"""`loopcal identifiability`: text, JSON, reduced robot file and contradictory options."""

import pytest

import loopcal as lc

READ = "linear-delta --draw 5 --sigma-reading"


@pytest.fixture
def loopcal(loopcal):
    """Run the command."""
    return lambda words, *said, **code: loopcal(f"identifiability {words}", *said, **code)


def test_3_prs_without_psi_has_one_unidentifiable_combination(loopcal):
    words = "3-prs --measure x,y,z,phi,theta --verbose"
    _, out, err = loopcal(words, "determine 32 of 33 parameter combinations")
    assert err == ""
    document = loopcal("3-prs --measure x,y,z,phi,theta --json").json
    (combination,) = document["unidentifiable"]
    assert set(combination["names"]) == {"a1y", "a2y", "a3y"}
    assert document["remedies"][0]["cures"][0]["words"] == "psi"
    states = {row["name"]: row["state"] for row in document["parameters"]}
    assert states["a2y"] == "together"
    assert [line.split()[0] for line in out.splitlines() if line.startswith("O")][-1] == "O5"


def test_ru_pus_prs_without_psi_has_rank_24_of_25(loopcal):
    document = loopcal("ru-pus-prs --measure x,y,z,phi,theta --json").json
    assert (document["rank"], document["n_parameters"]) == (24, 25)


@pytest.mark.parametrize(("frames", "rank"), [("base", 36), ("tool", 36), ("base,tool", 30)])
def test_two_unknown_frames_reduce_the_rank_of_the_hexapod_by_twelve(loopcal, frames, rank):
    assert loopcal(f"hexapod-42 --frames {frames} --json").json["rank"] == rank


def test_json_gives_the_reason_for_a_number_that_is_not_finite(loopcal):
    """At full rank the gap of the singular values is infinite."""
    document = loopcal("hexapod-42 --json").json
    assert document["gap"] is None
    assert document["nulls"]["gap"].startswith("infinite")


def test_reduce_writes_a_robot_file_with_identifiable_parameters_only(loopcal, tmp_path):
    words = "hexapod-42 --frames base --fix-unidentifiable -o smaller.yaml"
    out = loopcal(words, "36 of 42 parameters contain all information").out
    assert out.count("Fix leg") == 6
    assert lc.load_robot(tmp_path / "smaller.yaml").parameters.free.sum() == 36
    assert loopcal("smaller.yaml --frames base --json").json["rank"] == 36
    loopcal(words, "this file exists", code=1)
    loopcal(f"{words} --force")


def test_json_contains_combinations_suggestions_reduction_and_indices(loopcal):
    document = loopcal("3-prs --measure x,y,z,phi,theta --fix-unidentifiable --json").json
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
        ("3-prs --frames floor", "an unknown frame is 'floor', but must be one of 'base', 'tool'"),
        ("3-prs --kind inclination --frames base", "this kind of measurement has no base frame"),
        ("3-prs data.csv --measure x", "DATA defines the instrument"),
        ("3-prs -o smaller.yaml", "-o writes the robot of --fix-unidentifiable"),
        (f"{READ}=5", "--sigma-reading '5' for q1: '5' has no unit"),
        (f"{READ}=5urad", "'urad' is a unit of angle, not of a length"),
        (f"{READ}=-5um", "for q1 is -5um. Give a number above zero, or zero for exact"),
        (f"{READ}=q9=5um", "--sigma-reading names 'q9'"),
        (f"{READ}=q1=5um,q2", "--sigma-reading 'q2' for q1: "),
        ("hexapod-42 --rank-tolerance 1", "--rank-tolerance"),
    ],
)
def test_contradictory_options_are_refused_in_one_sentence(loopcal, words, sentence):
    loopcal(words, sentence, code=1)


def test_sigma_reading_reduces_the_singular_values(loopcal):
    """Readings with sigma 1 mm instead of exact ones, and positions with sigma 10 um."""
    words = "linear-delta --draw 20 --kind position --json"
    exact, noisy = (
        loopcal(words + more).json["singular_values"] for more in ("", " --sigma-reading 1mm")
    )
    assert max(noisy) < 0.1 * max(exact)
    assert (
        loopcal(
            "linear-delta --draw 20 --kind position --json --sigma-reading q1=1mm,q2=1mm,q3=1mm"
        ).out
        == loopcal(words + " --sigma-reading 1mm").out
    )


@pytest.mark.slow
def test_the_summary_says_what_is_undetermined_and_what_to_measure(loopcal):
    out = loopcal("hexapod-42 --frames base,tool").words
    assert "determine 30 of 42 parameter combinations (rank tolerance 1e-11 of" in out
    assert "12 undetermined combinations only move the base and platform frames" in out
    assert "Measure the pose as well: this determines all of them." in out
    assert "leg1.base.x" not in out
    summary, full = (loopcal(f"hexapod-42 --frames base,tool{more}").out for more in ("", " -v"))
    assert len(summary.splitlines()) < 20 < len(full.splitlines())
    assert "leg1.base.x" in full


def test_directions_that_change_poses_are_named_in_the_summary(loopcal):
    document = loopcal("linear-delta --draw 20 --kind component --components z --json").json
    codes = {finding["code"]: finding["data"] for finding in document["summary"]}
    assert codes["identifiability.rank"]["rank"] == document["rank"]
    undetermined = document["n_parameters"] - document["rank"]
    parts = [codes.get(f"identifiability.{code}") for code in ("frames-only", "changes-poses")]
    assert sum(part["count"] for part in parts if part) == undetermined


@pytest.mark.slow
def test_a_rank_tolerance_is_applied_and_printed(loopcal):
    usual = loopcal("hexapod-42 --json").json
    cut = loopcal("hexapod-42 --json --rank-tolerance 0.02").json
    s = usual["singular_values"]
    assert cut["rank"] == sum(value > 0.02 * s[0] for value in s) < usual["rank"] == 42
    assert cut["tolerance"] == 0.02
    loopcal("hexapod-42 --rank-tolerance 0.02", "(rank tolerance 2e-02 of")
