# SPDX-License-Identifier: Apache-2.0
"""Known surfaces in an unknown frame: a body with known dimensions that lies somewhere."""

import numpy as np
import pytest

import loopcal as lc

EDGE = 0.08
NORMALS = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=float)
TRUE = {"cube.x": 0.0007, "cube.z": -0.0003, "cube.rz": 0.008}


def probe_cube(
    unknown: tuple[str, ...], edge: float = EDGE
) -> tuple[lc.Mechanism, lc.Measurements]:
    """Return a hexapod, and probed points of five faces of a cube in truth at `TRUE`."""
    robot = lc.load_robot("hexapod-octahedral")
    T, random = np.eye(4), np.random.default_rng(3)
    T[2, 3] = 0.3
    coordinates, sensors = [], []
    for i, normal in enumerate(NORMALS):
        along = random.uniform(-0.03, 0.03, (12, 3)) * (normal == 0.0)
        tips = T[:3, 3] + EDGE / 2 * normal + along
        rows = np.arange(12 * i, 12 * i + 12)
        coordinates.append(np.hstack([tips, random.uniform(-0.14, 0.14, (12, 3))]))
        kind = lc.Plane(
            surface=f"face{i}",
            through=edge / 2 * normal,
            along=normal,
            T_base_frame=T,
            frame="cube",
            unknown=unknown,
        )
        sensors.append(lc.Sensor(kind, lc.Gaussian(np.array([1e-6])), rows=rows))
    machine = robot.with_values(lc.sample_truth(robot, 1, seed=8)[0])
    setup = TRUE if "frame" in unknown else None
    instrument = lc.Instrument(tuple(sensors))
    data = lc.simulate(machine, np.concatenate(coordinates), instrument, 5, nuisance_values=setup)
    return machine, data


def test_cube_somewhere_calibrates_a_hexapod_and_its_frame_is_found() -> None:
    machine, data = probe_cube(("frame",))
    fit = lc.identify(machine.nominal, data)
    assert fit.nuisance.names == tuple(f"cube.{c}" for c in ("rx", "ry", "rz", "x", "y", "z"))
    errors = [(fit.nuisance.values[name] - TRUE.get(name, 0.0)) for name in fit.nuisance.names]
    assert np.all(np.abs(errors) < 4.0 * fit.nuisance.sd)
    check = lc.compare_with_truth(fit, machine.values)
    assert check.compared == 33
    assert check.p_value > 1e-3


def test_cube_has_the_scale_of_the_machine() -> None:
    """A cube stated too large by a thousandth has points of a machine that is as much too large."""
    machine, data = probe_cube(("frame",))
    _, wrong = probe_cube(("frame",), edge=EDGE * 1.001)
    right, large = (lc.identify(machine.nominal, d, lc.LeastSquares()) for d in (data, wrong))
    assert large.chi_square == pytest.approx(right.chi_square, rel=0.2)


def test_frame_and_surfaces_together_cannot_be_determined_and_a_finding_says_so() -> None:
    machine, data = probe_cube(("frame", "surface"))
    fit = lc.identify(machine.nominal, data)
    assert "setup.unobservable" in [finding.code for finding in fit.findings]


def test_undeclared_frame_of_surfaces_is_no_interpretation() -> None:
    machine, data = probe_cube(())
    assert lc.check_conventions(machine.nominal, data).finding is None
