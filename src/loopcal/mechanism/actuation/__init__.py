# SPDX-License-Identifier: Apache-2.0
"""Actuation: which joints are driven, by fewer readings than joints, or by more than freedoms.

The names below are imported when they are used: most robots have as many readings as driven joints.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.mechanism.actuation.summed_drives import Motion as Motion
    from loopcal.mechanism.actuation.summed_drives import (
        differentiate_driven_joints as differentiate_driven_joints,
    )
    from loopcal.mechanism.actuation.summed_drives import (
        differentiate_joints_by_readings as differentiate_joints_by_readings,
    )
    from loopcal.mechanism.actuation.summed_drives import (
        differentiate_lengths as differentiate_lengths,
    )
    from loopcal.mechanism.actuation.summed_drives import (
        differentiate_open_sums as differentiate_open_sums,
    )
    from loopcal.mechanism.actuation.summed_drives import solve_open_sums as solve_open_sums
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.mechanism.actuation.summed_drives": """
                Motion differentiate_driven_joints differentiate_joints_by_readings
                differentiate_lengths differentiate_open_sums solve_open_sums
            """
        },
    )
