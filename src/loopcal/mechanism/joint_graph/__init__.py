# SPDX-License-Identifier: Apache-2.0
"""Mechanisms given as bodies and joints, such as a URDF with closures, divided into limbs."""

from loopcal.mechanism.joint_graph.limb_paths import LimbPaths as LimbPaths
from loopcal.mechanism.joint_graph.limb_paths import choose_coordinates as choose_coordinates
from loopcal.mechanism.joint_graph.limb_paths import find_limb_paths as find_limb_paths
from loopcal.mechanism.joint_graph.limb_paths import get_other_body as get_other_body
from loopcal.mechanism.joint_graph.limb_paths import orient_path as orient_path
from loopcal.mechanism.joint_graph.loop_closure import GraphJoint as GraphJoint
from loopcal.mechanism.joint_graph.loop_closure import JointGraph as JointGraph
from loopcal.mechanism.joint_graph.loop_closure import find_home as find_home
