# SPDX-License-Identifier: Apache-2.0
"""Rotations, poses and twists, batched over any leading axes. NumPy only."""

from loopcal.geometry.euler_angles import EULER_ORDERS as EULER_ORDERS
from loopcal.geometry.euler_angles import euler_rates as euler_rates
from loopcal.geometry.euler_angles import euler_rates_inverse as euler_rates_inverse
from loopcal.geometry.euler_angles import euler_to_matrix as euler_to_matrix
from loopcal.geometry.euler_angles import matrix_to_euler as matrix_to_euler
from loopcal.geometry.euler_angles import matrix_to_tilt_torsion as matrix_to_tilt_torsion
from loopcal.geometry.euler_angles import rotation_about_axis as rotation_about_axis
from loopcal.geometry.euler_angles import tilt_torsion_rates as tilt_torsion_rates
from loopcal.geometry.euler_angles import tilt_torsion_rates_inverse as tilt_torsion_rates_inverse
from loopcal.geometry.euler_angles import tilt_torsion_to_matrix as tilt_torsion_to_matrix
from loopcal.geometry.euler_angles import wrap_angle as wrap_angle
from loopcal.geometry.orientation_forms import OrientationForm as OrientationForm
from loopcal.geometry.orientation_forms import parse_orientation as parse_orientation
from loopcal.geometry.rigid_transforms import apply_twist as apply_twist
from loopcal.geometry.rigid_transforms import differentiate_by_entries as differentiate_by_entries
from loopcal.geometry.rigid_transforms import differentiate_by_frames as differentiate_by_frames
from loopcal.geometry.rigid_transforms import differentiate_entries as differentiate_entries
from loopcal.geometry.rigid_transforms import invert_pose as invert_pose
from loopcal.geometry.rigid_transforms import make_pose as make_pose
from loopcal.geometry.rigid_transforms import pose_difference as pose_difference
from loopcal.geometry.rigid_transforms import transport_matrix as transport_matrix
from loopcal.geometry.rotations import exp_so3 as exp_so3
from loopcal.geometry.rotations import hat as hat
from loopcal.geometry.rotations import left_jacobian_inverse_so3 as left_jacobian_inverse_so3
from loopcal.geometry.rotations import left_jacobian_so3 as left_jacobian_so3
from loopcal.geometry.rotations import log_so3 as log_so3
from loopcal.geometry.rotations import matrix_to_quaternion as matrix_to_quaternion
from loopcal.geometry.rotations import measure_rotation_error as measure_rotation_error
from loopcal.geometry.rotations import project_to_rotations as project_to_rotations
from loopcal.geometry.rotations import quaternion_to_matrix as quaternion_to_matrix
