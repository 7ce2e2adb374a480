# SPDX-License-Identifier: Apache-2.0
"""A command that is killed or interrupted while it writes leaves its old or its new outputs, and
blocks no later command. `make evidence` stops all writing commands at 200 moments each.
"""

import json
from pathlib import Path

import pytest

from evidence.interruption import CASES, FIVE_BAR, INTERRUPT, KILL, examine, prepare_inputs
from evidence.interruption import list_failures as list_wrong_outcomes

pytestmark = pytest.mark.forks

RESULT = Path(__file__).parents[2] / "docs" / "evidence" / "interruption.json"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    prepare_inputs(folder)
    return folder


@pytest.mark.slow
def test_two_files_are_written_together_or_restored(tmp_path) -> None:
    outcomes = examine(CASES["new"], tmp_path, 8, 3)
    assert list_wrong_outcomes(outcomes) == []
    assert set(outcomes[INTERRUPT]) == {"old", "new"}


@pytest.mark.slow
def test_run_folder_is_the_old_or_the_new_one(inputs) -> None:
    outcomes = examine(CASES["calibrate"], inputs, 4, 2)
    assert list_wrong_outcomes(outcomes) == []
    assert {"old", "new"} <= set(outcomes[KILL]) | set(outcomes[INTERRUPT])


@pytest.mark.slow
def test_first_run_folder_is_absent_or_complete(inputs) -> None:
    assert list_wrong_outcomes(examine(CASES["calibrate, no old run"], inputs, 3, 0)) == []
    assert sorted(FIVE_BAR) == ["data.csv", "run", "targets.csv"]


@pytest.mark.evidence
def test_all_writing_commands_were_stopped_at_fifty_moments() -> None:
    document = json.loads(RESULT.read_text())
    rows = document["tables"]["outcomes"]["rows"]
    assert {row[0] for row in rows} == set(CASES)
    assert document["moments"] >= 50
    assert document["failures"] == []
    for _, kind, count, *_, failed in rows:
        assert count == document["times" if "slow" in kind else "moments"]
        assert failed == 0
    kinds = {kind for name, kind, *_ in rows}
    assert len(rows) == len(CASES) * len(kinds) == len(CASES) * 4
