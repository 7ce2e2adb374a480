# SPDX-License-Identifier: Apache-2.0
"""Rotations, poses and twists, batched over any leading axes; numpy only."""

from loopcal.se3.angles import EULER_ORDERS as EULER_ORDERS
from loopcal.se3.angles import axis_rotation as axis_rotation
from loopcal.se3.angles import euler_rates as euler_rates
from loopcal.se3.angles import euler_rates_inverse as euler_rates_inverse
from loopcal.se3.angles import euler_to_matrix as euler_to_matrix
from loopcal.se3.angles import matrix_to_euler as matrix_to_euler
from loopcal.se3.angles import matrix_to_tilt_torsion as matrix_to_tilt_torsion
from loopcal.se3.angles import tilt_torsion_rates as tilt_torsion_rates
from loopcal.se3.angles import tilt_torsion_rates_inverse as tilt_torsion_rates_inverse
from loopcal.se3.angles import tilt_torsion_to_matrix as tilt_torsion_to_matrix
from loopcal.se3.angles import wrap as wrap
from loopcal.se3.rigid import adjoint as adjoint
from loopcal.se3.rigid import compose as compose
from loopcal.se3.rigid import difference as difference
from loopcal.se3.rigid import exp_update as exp_update
from loopcal.se3.rigid import inverse as inverse
from loopcal.se3.rigid import pose as pose
from loopcal.se3.rigid import transport as transport
from loopcal.se3.rotation import exp_so3 as exp_so3
from loopcal.se3.rotation import hat as hat
from loopcal.se3.rotation import left_jacobian_inverse_so3 as left_jacobian_inverse_so3
from loopcal.se3.rotation import left_jacobian_so3 as left_jacobian_so3
from loopcal.se3.rotation import log_so3 as log_so3
from loopcal.se3.rotation import matrix_to_quaternion as matrix_to_quaternion
from loopcal.se3.rotation import quaternion_to_matrix as quaternion_to_matrix
