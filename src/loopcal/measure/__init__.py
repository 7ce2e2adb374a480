# SPDX-License-Identifier: Apache-2.0
"""Measurements: kinds, instruments, observations, and their simulation."""

from loopcal.measure.checks import check_actuators as check_actuators
from loopcal.measure.checks import check_duplicates as check_duplicates
from loopcal.measure.checks import check_strokes as check_strokes
from loopcal.measure.commanded import readings_from_commanded as readings_from_commanded
from loopcal.measure.instrument import Instrument as Instrument
from loopcal.measure.instrument import Sensor as Sensor
from loopcal.measure.kinds import KINDS as KINDS
from loopcal.measure.kinds import Column as Column
from loopcal.measure.kinds import Component as Component
from loopcal.measure.kinds import Evaluation as Evaluation
from loopcal.measure.kinds import Kind as Kind
from loopcal.measure.kinds import Pose as Pose
from loopcal.measure.measurements import Measurements as Measurements
from loopcal.measure.noise import Gaussian as Gaussian
from loopcal.measure.noise import Noise as Noise
from loopcal.measure.noise import Uniform as Uniform
from loopcal.measure.noise import stream as stream
from loopcal.measure.observations import Observations as Observations
from loopcal.measure.orientation import Orientation as Orientation
from loopcal.measure.orientation import orientation as orientation
from loopcal.measure.simulate import Trials as Trials
from loopcal.measure.simulate import sample_truth as sample_truth
from loopcal.measure.simulate import simulate as simulate
from loopcal.measure.simulate import simulate_trials as simulate_trials
