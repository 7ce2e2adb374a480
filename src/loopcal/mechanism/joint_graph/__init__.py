# SPDX-License-Identifier: Apache-2.0
"""Mechanisms given as bodies and joints, such as a URDF with closures, divided into limbs."""

from loopcal.mechanism.joint_graph.controlled_coordinates import (
    choose_coordinates as choose_coordinates,
)
from loopcal.mechanism.joint_graph.graph_assembly import Bodies as Bodies
from loopcal.mechanism.joint_graph.graph_assembly import Weld as Weld
from loopcal.mechanism.joint_graph.graph_assembly import assemble_graph as assemble_graph
from loopcal.mechanism.joint_graph.graph_assembly import weld_bodies as weld_bodies
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint as GraphJoint
from loopcal.mechanism.joint_graph.graph_joint import find_perpendicular as find_perpendicular
from loopcal.mechanism.joint_graph.graph_joint import list_axes_across as list_axes_across
from loopcal.mechanism.joint_graph.graph_joint import turn_between as turn_between
from loopcal.mechanism.joint_graph.home_pose import (
    count_repeated_closures as count_repeated_closures,
)
from loopcal.mechanism.joint_graph.home_pose import get_value as get_value
from loopcal.mechanism.joint_graph.home_pose import list_nearby as list_nearby
from loopcal.mechanism.joint_graph.home_pose import measure_rotation as measure_rotation
from loopcal.mechanism.joint_graph.limb_paths import LimbPaths as LimbPaths
from loopcal.mechanism.joint_graph.loop_closure import JointGraph as JointGraph
from loopcal.mechanism.joint_graph.stage_paths import ClosedStage as ClosedStage
from loopcal.mechanism.joint_graph.stage_paths import SerialStage as SerialStage
from loopcal.mechanism.joint_graph.stage_paths import StagePaths as StagePaths
from loopcal.mechanism.joint_graph.stage_paths import find_stage_paths as find_stage_paths
from loopcal.mechanism.joint_graph.stage_paths import (
    list_possible_platforms as list_possible_platforms,
)
