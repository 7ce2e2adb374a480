# SPDX-License-Identifier: Apache-2.0
"""Chains of stages: each stage is a mechanism whose base is the platform of another stage.

The pose of the end platform is the product of the mounts and poses of the stages that carry it,
its derivatives are those of the stages, transported to the end. The functions of
`loopcal.mechanism` that every robot has call these modules where a robot has stages, and hand over
the function that solves a single stage. The names below are imported when they are used, since most
robots have no stages. Derivation: docs/theory/stages.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.mechanism.stages.chain_inverse import solve_readings as solve_readings
    from loopcal.mechanism.stages.chain_kinematics import differentiate_end as differentiate_end
    from loopcal.mechanism.stages.chain_kinematics import (
        differentiate_joints as differentiate_joints,
    )
    from loopcal.mechanism.stages.chain_kinematics import (
        differentiate_platform_entries as differentiate_platform_entries,
    )
    from loopcal.mechanism.stages.chain_kinematics import judge_stage_modes as judge_stage_modes
    from loopcal.mechanism.stages.chain_kinematics import multiply_signs as multiply_signs
    from loopcal.mechanism.stages.chain_kinematics import (
        name_platform_entries as name_platform_entries,
    )
    from loopcal.mechanism.stages.chain_kinematics import solve_stages as solve_stages
    from loopcal.mechanism.stages.chain_state import (
        compute_stage_limb_frames as compute_stage_limb_frames,
    )
    from loopcal.mechanism.stages.joined_assembly import StageError as StageError
    from loopcal.mechanism.stages.serial_limb import solve_serial as solve_serial
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.mechanism.stages.chain_inverse": "solve_readings",
            "loopcal.mechanism.stages.chain_kinematics": """
                differentiate_end differentiate_joints differentiate_platform_entries
                judge_stage_modes multiply_signs name_platform_entries solve_stages
            """,
            "loopcal.mechanism.stages.chain_state": "compute_stage_limb_frames",
            "loopcal.mechanism.stages.joined_assembly": "StageError",
            "loopcal.mechanism.stages.serial_limb": "solve_serial",
        },
    )
