# SPDX-License-Identifier: Apache-2.0
"""Mechanisms: robot records and families, their compilation for the engine, inverse and forward
kinematics.
"""

from loopcal.mechanism.assembly import AXES as AXES
from loopcal.mechanism.assembly import Actuator as Actuator
from loopcal.mechanism.assembly import Address as Address
from loopcal.mechanism.assembly import Assembly as Assembly
from loopcal.mechanism.assembly import Joint as Joint
from loopcal.mechanism.assembly import Limb as Limb
from loopcal.mechanism.assembly import Linear as Linear
from loopcal.mechanism.assembly import Link as Link
from loopcal.mechanism.compilation import build as build
from loopcal.mechanism.families import FAMILIES as FAMILIES
from loopcal.mechanism.kinematics import Solution as Solution
from loopcal.mechanism.kinematics import forward as forward
from loopcal.mechanism.kinematics import inverse as inverse
from loopcal.mechanism.model import Mechanism as Mechanism
from loopcal.mechanism.model import Status as Status
from loopcal.mechanism.modes import assembly_modes as assembly_modes
from loopcal.mechanism.modes import working_modes as working_modes
from loopcal.mechanism.records import Robot as Robot
from loopcal.mechanism.singularities import Singularity as Singularity
from loopcal.mechanism.singularities import along_path as along_path
from loopcal.mechanism.singularities import singularity as singularity
from loopcal.mechanism.workspace import sample as sample
