# SPDX-License-Identifier: Apache-2.0
"""Measurements: kinds, instruments, observations, nuisance parameters, and their simulation."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.measure.closure_checks import check_closure as check_closure
    from loopcal.measure.closure_checks import check_redundancy as check_redundancy
    from loopcal.measure.contact_simulation import simulate_contacts as simulate_contacts
    from loopcal.measure.data_checks import check_actuators as check_actuators
    from loopcal.measure.data_checks import check_duplicates as check_duplicates
    from loopcal.measure.data_checks import check_strokes as check_strokes
    from loopcal.measure.data_checks import check_targets_move as check_targets_move
    from loopcal.measure.data_checks import describe_outside_strokes as describe_outside_strokes
    from loopcal.measure.data_checks import find_outside_strokes as find_outside_strokes
    from loopcal.measure.data_checks import has_static_targets as has_static_targets
    from loopcal.measure.disturbances import Disturbance as Disturbance
    from loopcal.measure.evaluation import EvaluatedRows as EvaluatedRows
    from loopcal.measure.evaluation import evaluate_measurements as evaluate_measurements
    from loopcal.measure.evaluation import whiten_rows as whiten_rows
    from loopcal.measure.fitted_rows import FittedRows as FittedRows
    from loopcal.measure.fitted_rows import collect_fitted_rows as collect_fitted_rows
    from loopcal.measure.fitted_rows import fitted_rows_from_arrays as fitted_rows_from_arrays
    from loopcal.measure.initial_values import guess_nuisance_values as guess_nuisance_values
    from loopcal.measure.initial_values import (
        guess_nuisance_values_batch as guess_nuisance_values_batch,
    )
    from loopcal.measure.instrument import BlockStream as BlockStream
    from loopcal.measure.instrument import Gaussian as Gaussian
    from loopcal.measure.instrument import Instrument as Instrument
    from loopcal.measure.instrument import Noise as Noise
    from loopcal.measure.instrument import Seed as Seed
    from loopcal.measure.instrument import Sensor as Sensor
    from loopcal.measure.instrument import Uniform as Uniform
    from loopcal.measure.instrument import make_random_stream as make_random_stream
    from loopcal.measure.kinds import KINDS as KINDS
    from loopcal.measure.kinds import ActuatorReadings as ActuatorReadings
    from loopcal.measure.kinds import Autocollimation as Autocollimation
    from loopcal.measure.kinds import Bearing as Bearing
    from loopcal.measure.kinds import Closure as Closure
    from loopcal.measure.kinds import Column as Column
    from loopcal.measure.kinds import Component as Component
    from loopcal.measure.kinds import Direction as Direction
    from loopcal.measure.kinds import Distance as Distance
    from loopcal.measure.kinds import Evaluation as Evaluation
    from loopcal.measure.kinds import Inclination as Inclination
    from loopcal.measure.kinds import JointSensor as JointSensor
    from loopcal.measure.kinds import Kind as Kind
    from loopcal.measure.kinds import Line as Line
    from loopcal.measure.kinds import Locked as Locked
    from loopcal.measure.kinds import Plane as Plane
    from loopcal.measure.kinds import Pose as Pose
    from loopcal.measure.kinds import Position as Position
    from loopcal.measure.kinds import Separation as Separation
    from loopcal.measure.kinds import Sphere as Sphere
    from loopcal.measure.measurements import Measurements as Measurements
    from loopcal.measure.nuisance import NuisanceParameters as NuisanceParameters
    from loopcal.measure.nuisance import StatedValue as StatedValue
    from loopcal.measure.nuisance import collect_nuisance_parameters as collect_nuisance_parameters
    from loopcal.measure.observations import Observations as Observations
    from loopcal.measure.reading_sigma import fill_in_reading_sigma as fill_in_reading_sigma
    from loopcal.measure.reading_sigma import resolve_reading_sigma as resolve_reading_sigma
    from loopcal.measure.reading_sigma import weight_reading_sigma as weight_reading_sigma
    from loopcal.measure.readings import list_sensed_joints as list_sensed_joints
    from loopcal.measure.readings import make_readings_kind as make_readings_kind
    from loopcal.measure.readings import select_joint_values as select_joint_values
    from loopcal.measure.readings import solve_commanded_poses as solve_commanded_poses
    from loopcal.measure.simulation import Trials as Trials
    from loopcal.measure.simulation import replace_measured_values as replace_measured_values
    from loopcal.measure.simulation import sample_truth as sample_truth
    from loopcal.measure.simulation import simulate as simulate
    from loopcal.measure.simulation import simulate_trials as simulate_trials
    from loopcal.measure.traceability import InstrumentRecord as InstrumentRecord
    from loopcal.measure.traceability import check_instruments as check_instruments
    from loopcal.measure.traceability import list_instruments as list_instruments
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.measure.closure_checks": "check_closure check_redundancy",
            "loopcal.measure.contact_simulation": "simulate_contacts",
            "loopcal.measure.data_checks": """
                check_actuators check_duplicates check_strokes check_targets_move
                describe_outside_strokes find_outside_strokes has_static_targets
            """,
            "loopcal.measure.disturbances": "Disturbance",
            "loopcal.measure.evaluation": "EvaluatedRows evaluate_measurements whiten_rows",
            "loopcal.measure.fitted_rows": "FittedRows collect_fitted_rows fitted_rows_from_arrays",
            "loopcal.measure.initial_values": "guess_nuisance_values guess_nuisance_values_batch",
            "loopcal.measure.instrument": """
                BlockStream Gaussian Instrument Noise Seed Sensor Uniform make_random_stream
            """,
            "loopcal.measure.kinds": """
                KINDS ActuatorReadings Autocollimation Bearing Closure Column Component Direction
                Distance Evaluation Inclination JointSensor Kind Line Locked Plane Pose
                Position Separation Sphere
            """,
            "loopcal.measure.measurements": "Measurements",
            "loopcal.measure.nuisance": """
                NuisanceParameters StatedValue collect_nuisance_parameters
            """,
            "loopcal.measure.observations": "Observations",
            "loopcal.measure.reading_sigma": """
                fill_in_reading_sigma resolve_reading_sigma weight_reading_sigma
            """,
            "loopcal.measure.readings": """
                list_sensed_joints make_readings_kind select_joint_values solve_commanded_poses
            """,
            "loopcal.measure.simulation": """
                Trials replace_measured_values sample_truth simulate simulate_trials
            """,
            "loopcal.measure.traceability": "InstrumentRecord check_instruments list_instruments",
        },
    )
