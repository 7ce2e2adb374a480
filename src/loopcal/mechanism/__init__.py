# SPDX-License-Identifier: Apache-2.0
"""Mechanisms: robot records and families, compilation for the engine, kinematics and sensitivities.

Other packages import from here; the modules inside may be rearranged.
"""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.mechanism.actuation.driven_joints import DrivenJoints as DrivenJoints
    from loopcal.mechanism.actuation.driven_joints import drive_joints as drive_joints
    from loopcal.mechanism.actuation.redundant_actuation import (
        PoseDrivenSensitivity as PoseDrivenSensitivity,
    )
    from loopcal.mechanism.actuation.redundant_actuation import (
        differentiate_at_pose as differentiate_at_pose,
    )
    from loopcal.mechanism.actuation.redundant_actuation import solve_at_pose as solve_at_pose
    from loopcal.mechanism.analysis.modes import Modes as Modes
    from loopcal.mechanism.analysis.modes import find_assembly_modes as find_assembly_modes
    from loopcal.mechanism.analysis.modes import find_working_modes as find_working_modes
    from loopcal.mechanism.analysis.singularities import NEAR_SHARE as NEAR_SHARE
    from loopcal.mechanism.analysis.singularities import Singularity as Singularity
    from loopcal.mechanism.analysis.singularities import analyze_singularity as analyze_singularity
    from loopcal.mechanism.analysis.singularities import (
        compute_median_margins as compute_median_margins,
    )
    from loopcal.mechanism.analysis.singularities import trace_singularity as trace_singularity
    from loopcal.mechanism.analysis.workspace import MIN_DRAWS as MIN_DRAWS
    from loopcal.mechanism.analysis.workspace import MIN_REACHABLE_SHARE as MIN_REACHABLE_SHARE
    from loopcal.mechanism.analysis.workspace import Limit as Limit
    from loopcal.mechanism.analysis.workspace import WorkspaceSample as WorkspaceSample
    from loopcal.mechanism.analysis.workspace import check_limits as check_limits
    from loopcal.mechanism.analysis.workspace import draw_coordinates as draw_coordinates
    from loopcal.mechanism.analysis.workspace import evaluate_limits as evaluate_limits
    from loopcal.mechanism.analysis.workspace import resolve_poses as resolve_poses
    from loopcal.mechanism.analysis.workspace import sample_workspace as sample_workspace
    from loopcal.mechanism.analysis.workspace import workspace_ranges as workspace_ranges
    from loopcal.mechanism.assembly import AXES as AXES
    from loopcal.mechanism.assembly import Actuator as Actuator
    from loopcal.mechanism.assembly import Address as Address
    from loopcal.mechanism.assembly import Assembly as Assembly
    from loopcal.mechanism.assembly import Cone as Cone
    from loopcal.mechanism.assembly import Joint as Joint
    from loopcal.mechanism.assembly import Limb as Limb
    from loopcal.mechanism.assembly import LinearMap as LinearMap
    from loopcal.mechanism.assembly import Link as Link
    from loopcal.mechanism.assembly import SharedMap as SharedMap
    from loopcal.mechanism.compilation.assembly_compilation import build as build
    from loopcal.mechanism.compilation.over_constraint import (
        fix_breaking_parameters as fix_breaking_parameters,
    )
    from loopcal.mechanism.compilation.over_constraint import (
        refuse_drawn_errors as refuse_drawn_errors,
    )
    from loopcal.mechanism.compilation.over_constraint import (
        refuse_free_breaking_parameters as refuse_free_breaking_parameters,
    )
    from loopcal.mechanism.compilation.possible_values import (
        find_impossible_values as find_impossible_values,
    )
    from loopcal.mechanism.families import FAMILIES as FAMILIES
    from loopcal.mechanism.families.joint_release import (
        propose_added_joints as propose_added_joints,
    )
    from loopcal.mechanism.families.records import AngleTolerance as AngleTolerance
    from loopcal.mechanism.families.records import LengthTolerance as LengthTolerance
    from loopcal.mechanism.families.records import Point as Point
    from loopcal.mechanism.families.records import PoseRecord as PoseRecord
    from loopcal.mechanism.families.records import RatioTolerance as RatioTolerance
    from loopcal.mechanism.families.records import RobotRecord as RobotRecord
    from loopcal.mechanism.families.records import Workspace as Workspace
    from loopcal.mechanism.families.records import match_parameter_names as match_parameter_names
    from loopcal.mechanism.families.records import standard_deviation as standard_deviation
    from loopcal.mechanism.kinematics.batch_kinematics import (
        compute_closure_sign as compute_closure_sign,
    )
    from loopcal.mechanism.kinematics.batch_kinematics import compute_readings as compute_readings
    from loopcal.mechanism.kinematics.batch_kinematics import (
        find_directly_reachable as find_directly_reachable,
    )
    from loopcal.mechanism.kinematics.batch_kinematics import forward_trials as forward_trials
    from loopcal.mechanism.kinematics.batch_kinematics import inverse_trials as inverse_trials
    from loopcal.mechanism.kinematics.batch_kinematics import (
        step_towards_closure as step_towards_closure,
    )
    from loopcal.mechanism.kinematics.link_frames import compute_limb_frames as compute_limb_frames
    from loopcal.mechanism.kinematics.nearest_pose import (
        differentiate_by_coordinates as differentiate_by_coordinates,
    )
    from loopcal.mechanism.kinematics.pose_solutions import Jacobian as Jacobian
    from loopcal.mechanism.kinematics.pose_solutions import Solution as Solution
    from loopcal.mechanism.kinematics.pose_solutions import forward as forward
    from loopcal.mechanism.kinematics.pose_solutions import inverse as inverse
    from loopcal.mechanism.kinematics.pose_solutions import jacobian as jacobian
    from loopcal.mechanism.kinematics.pose_solutions import make_solution as make_solution
    from loopcal.mechanism.kinematics.triangle_anchors import locate_anchors as locate_anchors
    from loopcal.mechanism.model import Mechanism as Mechanism
    from loopcal.mechanism.parameter_units import ParameterUnits as ParameterUnits
    from loopcal.mechanism.platform_coordinates import POSITION as POSITION
    from loopcal.mechanism.platform_coordinates import TILT as TILT
    from loopcal.mechanism.platform_coordinates import check_coordinates as check_coordinates
    from loopcal.mechanism.platform_coordinates import compare_coordinates as compare_coordinates
    from loopcal.mechanism.platform_coordinates import (
        pose_from_coordinates as pose_from_coordinates,
    )
    from loopcal.mechanism.platform_coordinates import read_coordinates as read_coordinates
    from loopcal.mechanism.sensitivity import PassiveSensitivity as PassiveSensitivity
    from loopcal.mechanism.sensitivity import PoseSensitivity as PoseSensitivity
    from loopcal.mechanism.sensitivity import (
        differentiate_passive_joints as differentiate_passive_joints,
    )
    from loopcal.mechanism.sensitivity import differentiate_pose as differentiate_pose
    from loopcal.mechanism.sensitivity import (
        differentiate_sensed_values as differentiate_sensed_values,
    )
    from loopcal.mechanism.sensitivity import fold_pose_rows as fold_pose_rows
    from loopcal.mechanism.stages.chain_kinematics import (
        name_platform_entries as name_platform_entries,
    )
    from loopcal.mechanism.stages.chain_kinematics import (
        select_platform_entries as select_platform_entries,
    )
    from loopcal.mechanism.states import Status as Status
    from loopcal.mechanism.states import driven_values as driven_values
    from loopcal.mechanism.states import select_poses as select_poses
    from loopcal.mechanism.transmission.terms import TERMS as TERMS
    from loopcal.mechanism.transmission.terms import WEIGHT as WEIGHT
    from loopcal.mechanism.transmission.terms import harmonic_frequencies as harmonic_frequencies
    from loopcal.mechanism.transmission.terms import joint_slopes as joint_slopes
    from loopcal.mechanism.transmission.terms import joints_from_readings as joints_from_readings
    from loopcal.mechanism.transmission.terms import nominal_terms as nominal_terms
    from loopcal.mechanism.transmission.terms import readings_from_joints as readings_from_joints
    from loopcal.mechanism.transmission.terms import term_derivatives as term_derivatives
    from loopcal.mechanism.transmission.terms import transmit_readings as transmit_readings
    from loopcal.mechanism.transmission.triangle import TRIANGLE_TERMS as TRIANGLE_TERMS
    from loopcal.mechanism.transmission.triangle import compute_range as compute_range
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.mechanism.analysis.modes": "Modes find_assembly_modes find_working_modes",
            "loopcal.mechanism.analysis.singularities": """
                NEAR_SHARE Singularity analyze_singularity compute_median_margins
                trace_singularity
            """,
            "loopcal.mechanism.analysis.workspace": """
                MIN_DRAWS MIN_REACHABLE_SHARE Limit WorkspaceSample check_limits
                draw_coordinates evaluate_limits resolve_poses sample_workspace
                workspace_ranges
            """,
            "loopcal.mechanism.assembly": """
                AXES Actuator Address Assembly Cone Joint Limb LinearMap Link SharedMap
            """,
            "loopcal.mechanism.kinematics.batch_kinematics": """
                compute_closure_sign compute_readings find_directly_reachable forward_trials
                step_towards_closure
                inverse_trials
            """,
            "loopcal.mechanism.compilation.assembly_compilation": "build",
            "loopcal.mechanism.actuation.driven_joints": "DrivenJoints drive_joints",
            "loopcal.mechanism.families": "FAMILIES",
            "loopcal.mechanism.families.joint_release": "propose_added_joints",
            "loopcal.mechanism.families.records": """
                AngleTolerance LengthTolerance Point PoseRecord RatioTolerance RobotRecord
                Workspace match_parameter_names standard_deviation
            """,
            "loopcal.mechanism.kinematics.pose_solutions": """
                Jacobian Solution forward inverse jacobian make_solution
            """,
            "loopcal.mechanism.model": "Mechanism",
            "loopcal.mechanism.kinematics.nearest_pose": "differentiate_by_coordinates",
            "loopcal.mechanism.compilation.over_constraint": """
                fix_breaking_parameters refuse_drawn_errors refuse_free_breaking_parameters
            """,
            "loopcal.mechanism.parameter_units": "ParameterUnits",
            "loopcal.mechanism.platform_coordinates": """
                POSITION TILT check_coordinates compare_coordinates pose_from_coordinates
                read_coordinates
            """,
            "loopcal.mechanism.compilation.possible_values": "find_impossible_values",
            "loopcal.mechanism.actuation.redundant_actuation": """
                PoseDrivenSensitivity differentiate_at_pose solve_at_pose
            """,
            "loopcal.mechanism.sensitivity": """
                PassiveSensitivity PoseSensitivity differentiate_passive_joints
                differentiate_pose differentiate_sensed_values fold_pose_rows
            """,
            "loopcal.mechanism.stages.chain_kinematics": """
                name_platform_entries select_platform_entries
            """,
            "loopcal.mechanism.kinematics.link_frames": "compute_limb_frames",
            "loopcal.mechanism.states": "Status driven_values select_poses",
            "loopcal.mechanism.transmission.terms": """
                TERMS WEIGHT harmonic_frequencies joint_slopes joints_from_readings nominal_terms
                readings_from_joints term_derivatives transmit_readings
            """,
            "loopcal.mechanism.transmission.triangle": "TRIANGLE_TERMS compute_range",
            "loopcal.mechanism.kinematics.triangle_anchors": "locate_anchors",
        },
    )
