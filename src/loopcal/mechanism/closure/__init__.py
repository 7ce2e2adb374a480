# SPDX-License-Identifier: Apache-2.0
"""The closure of limbs: frames along a limb, its linearized rows, and loops that stay open.

The names below are imported when they are used: the loops of most robots close exactly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.mechanism.closure.open_closure import differentiate_open as differentiate_open
    from loopcal.mechanism.closure.open_closure import (
        differentiate_unknowns as differentiate_unknowns,
    )
    from loopcal.mechanism.closure.open_closure import fold_open_poses as fold_open_poses
    from loopcal.mechanism.closure.open_closure import list_unknown_joints as list_unknown_joints
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.mechanism.closure.open_closure": """
                differentiate_open differentiate_unknowns fold_open_poses list_unknown_joints
            """
        },
    )
