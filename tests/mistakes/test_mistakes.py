# SPDX-License-Identifier: Apache-2.0
"""Realistic mistakes of users lead to messages that name the mistake and its correction."""

import pytest

from tests.mistakes.cases import CASES
from tests.mistakes.machines import MACHINES
from tests.mistakes.workshop import CALIBRATE, Files, answer, check_answer


@pytest.fixture(scope="module")
def correct_files(tmp_path_factory) -> dict[str, Files]:
    """Return the correct files of each machine."""
    return {
        name: machine.make_files(tmp_path_factory.mktemp(name))
        for name, machine in MACHINES.items()
    }


def test_each_machine_has_ten_mistakes() -> None:
    assert {name: len(cases) for name, cases in CASES.items()} == dict.fromkeys(MACHINES, 10)


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_correct_files_lead_to_a_calibration_without_a_warning(
    name, correct_files, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    code, text = answer(correct_files[name], CALIBRATE, tmp_path, capsys)
    assert code == 0, text
    assert text.startswith("Calibrated: ")
    assert not any(word in text for word in ("warning", "failure", "note:", "Traceback"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mistake"), [(name, mistake) for name, cases in CASES.items() for mistake in cases]
)
def test_message_names_the_mistake(
    name, mistake, correct_files, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    check_answer(correct_files[name], CASES[name][mistake], tmp_path, capsys)
