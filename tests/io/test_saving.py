# SPDX-License-Identifier: Apache-2.0
"""Everything is saved by save_..(object, path); the other order is refused with this order."""

from collections.abc import Callable
from typing import Any

import pytest

import loopcal as lc
from tests.zoo import load_cached_robot

SAVERS: tuple[Callable[..., Any], ...] = (
    lc.save_robot,
    lc.save_run,
    lc.save_report,
    lc.save_comparison,
    lc.save_view,
)


@pytest.mark.parametrize("save", SAVERS)
def test_swapped_arguments_are_answered_by_the_order(save: Callable[..., Any]) -> None:
    with pytest.raises(lc.DataError, match=r"is of type Mechanism.*save_\.\.\(object, path\)"):
        save("file.html", load_cached_robot("five-bar"))


def test_swapped_arguments_of_measurements_are_answered_by_the_order() -> None:
    robot = load_cached_robot("five-bar")
    with pytest.raises(lc.DataError, match=r"is of type Mechanism.*save_\.\.\(object, path\)"):
        lc.save_measurements("file.csv", robot, robot)  # type: ignore[arg-type]


def test_every_public_saver_takes_the_object_before_the_path() -> None:
    savers = {name for name in dir(lc) if name.startswith(("save_", "write_"))}
    assert savers == {save.__name__ for save in (*SAVERS, lc.save_measurements)}
