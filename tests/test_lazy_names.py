# SPDX-License-Identifier: Apache-2.0
"""Registries whose entries are imported when they are looked up."""

from __future__ import annotations

import subprocess
import sys

import pytest

from loopcal.measure.kinds import KINDS
from loopcal.mechanism.families import FAMILIES


def test_entries_of_registries_have_the_names_of_their_keys() -> None:
    assert [kind.name for kind in KINDS.values()] == list(KINDS)
    assert [family.family for family in FAMILIES.values()] == list(FAMILIES)
    assert "pose" in KINDS
    assert "Pose" in repr(KINDS)
    assert len(FAMILIES) == len({*FAMILIES.values()})
    with pytest.raises(KeyError):
        _ = KINDS["poses"]


def test_a_registry_imports_an_entry_when_it_is_looked_up() -> None:
    code = (
        "import sys; from loopcal.mechanism.families import FAMILIES; list(FAMILIES); "
        "'gough' in FAMILIES; "
        "name = 'loopcal.mechanism.families.gough'; before = name in sys.modules; "
        "FAMILIES['gough']; print(before, name in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False True\n"
