# SPDX-License-Identifier: Apache-2.0
"""Identifiability of five real delta printers from their probes: rank, condition, intervals and
chi-square.

Conditions are of rows divided by one sigma and columns of 1 mm and 1 degree. The records in
LOOPCAL_DATA/delta_printers describe the printers and what their firmware stored.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loopcal.diagnose.identifiable_parameters import identifiability, suggest_measurements
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.formats import klipper
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import Imported, ImportOptions
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from tests.cli.delta_printers import read_records
from tests.io.formats.printers import format_printer_cfg

GEOMETRY = ("radius", "tower1.angle", "tower2.angle", "tower1.stop", "tower2.stop", "tower3.stop")
ARMS = ("arm1.length", "arm2.length", "arm3.length")
WITH_DISTANCES = "RazorCopter/Klipper_FLSUN_Q5 printer [Post-Calibration].cfg"
UNIT_TOLERANCES = "tolerances: {radius: {sd: 1}, angles: {sd: 1}, arms: {sd: 1}, stops: {sd: 1}}\n"

Printer = tuple[Mechanism, Measurements]


@pytest.fixture(scope="module")
def printers(data_folder: Path, tmp_path_factory) -> dict[str, Printer]:
    """Every printer with nine free parameters of tolerance 1 mm or 1 degree, and its probes."""
    result = {}
    for name, record in read_records(data_folder).items():
        path = tmp_path_factory.mktemp("printer") / "printer.cfg"
        path.write_text(format_printer_cfg(record), "utf-8")
        read = klipper.read(path, ImportOptions("printer"))
        lines = [
            line
            for line in read.robot_text.splitlines(keepends=True)
            if not line.startswith("fixed")
        ]
        assert read.measurements is not None
        result[name] = (
            build_imported_robot(path, Imported("".join(lines) + UNIT_TOLERANCES)),
            read.measurements,
        )
    assert len(result) == 5
    return result


def free_only(robot: Mechanism, *names: str) -> Mechanism:
    """Return the robot with only these parameters free."""
    return replace(robot, parameters=robot.parameters.with_free(names))


def with_sigmas(data: Measurements, height: float, distance: float) -> Measurements:
    """Replace the sigmas of heights and distances [m]."""
    rows = [
        Observations.from_sigma(
            o.kind, o.rows, o.measured, height if o.kind.poses_per_row == 1 else distance
        )
        for o in data.observations
    ]
    return replace(data, observations=tuple(rows))


def select_heights(data: Measurements) -> Measurements:
    """Keep the heights only."""
    return replace(
        data, observations=tuple(o for o in data.observations if o.kind.poses_per_row == 1)
    )


def test_six_parameters_are_well_conditioned_from_seven_heights(printers):
    for name, (robot, data) in printers.items():
        result = identifiability(free_only(robot, *GEOMETRY), select_heights(data))
        assert result.rank == result.n_parameters == 6, name
        assert 6.0 < result.condition < 8.0, name


def test_one_free_arm_makes_the_condition_about_thirty_times_worse(printers):
    """Seven parameters from seven heights can be computed but are nearly meaningless."""
    first = []
    for name, (robot, data) in printers.items():
        result = [
            identifiability(free_only(robot, *GEOMETRY, arm), select_heights(data)) for arm in ARMS
        ]
        assert {one.rank for one in result} == {7}, name
        assert all(140.0 < one.condition < 480.0 for one in result), name
        first.append(result[0].condition)
    assert 185.0 < min(first) < max(first) < 320.0


def test_heights_leave_two_of_nine_parameters_undetermined_and_distances_are_suggested(printers):
    for name, (robot, data) in printers.items():
        result = identifiability(robot, select_heights(data))
        assert (result.rank, result.n_parameters, result.n_equations) == (7, 9, 7), name
        assert result.gap > 1e10, name  # the two singular values that are cut are rounding
        unidentifiable = [set(combination.names) for combination in result.unidentifiable]
        assert len(unidentifiable) == 2
        assert all(names & set(ARMS) for names in unidentifiable), name
        for suggestion in suggest_measurements(result):
            assert (
                suggestion.measurements[0].words
                == "distances between two poses (ball bar; calipers on a printed part)"
            ), name


def test_heights_and_twelve_distances_determine_nine_parameters(printers):
    robot, data = printers[WITH_DISTANCES]
    one = identifiability(robot, with_sigmas(data, 1e-3, 1e-3))
    assert one.rank == 9
    assert 44.0 < one.condition < 50.0
    # the condition depends on the ratio of sigmas: a distance constrains less than a height
    firmware = identifiability(robot, with_sigmas(data, 1e-3 / np.sqrt(2 * 12 / 7), 1e-3))
    assert 33.0 < firmware.condition < 38.0


def test_usual_sigmas_of_probe_and_callipers_explain_the_residuals(printers):
    """With 0.05 mm for the probe and 0.3 mm for callipers on plastic; with 0.02 and 0.1 mm,
    chi-square refuses, were they exact.
    """
    robot, data = printers[WITH_DISTANCES]
    small = identify(robot, with_sigmas(data, 0.02e-3, 0.1e-3), LeastSquares())
    assert small.residual_test.exceeds_sigma
    assert small.residual_test.sigma_scale > 2.5
    fit = identify(robot, with_sigmas(data, 0.05e-3, 0.3e-3), LeastSquares())
    assert fit.residual_test.dof == pytest.approx(10.0)
    assert not fit.residual_test.failed
    # chi-square of 10 degrees of freedom is between 3.25 and 20.5 in 95 % of data
    assert 3.25 < fit.chi_square < 20.5
    half = dict(zip(fit.names, 1.96 * fit.standard_deviations / 1e-3, strict=True))  # [mm]
    assert all(1.5 < half[arm] < 3.0 for arm in ARMS)  # the arms are hardly known
    assert all(half[f"tower{k}.stop"] < 0.5 for k in (1, 2, 3))
    # the firmware's own optimum is 0.2 mm from what it stored: far inside these intervals
    assert half["arm1.length"] > 5 * abs(217.6266 - 217.4260)


def test_doubled_sigma_doubles_intervals_and_quarters_chi_square(printers):
    name = next(n for n in printers if n.startswith("fzechert"))
    robot, data = free_only(printers[name][0], *GEOMETRY), printers[name][1]
    exact = FitOptions(sigma_uncertainty=0.0)
    narrow, wide = (
        identify(robot, with_sigmas(data, sigma, 1.0), LeastSquares(), options=exact)
        for sigma in (0.01e-3, 0.02e-3)
    )
    assert not narrow.residual_test.failed
    np.testing.assert_allclose(wide.standard_deviations, 2 * narrow.standard_deviations, rtol=1e-6)
    assert wide.chi_square == pytest.approx(narrow.chi_square / 4, rel=1e-6)
