# SPDX-License-Identifier: Apache-2.0
"""A bias, a drift and a scale of an instrument, declared in one line of a measurement file."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.errors import FileError
from loopcal.estimate.identification import identify
from loopcal.io.data.measurement_file import load_instrument, load_measurements, save_measurements
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism.workspace import sample_workspace
from tests.diagnose.correlated_data import LENGTH, ROBOTS, draw_errors, measure

DELTA = ROBOTS["linear-delta"]
TRUE_BIAS = np.array([[30.0, -10.0, 5.0], [-20.0, 15.0, -5.0], [-10.0, -5.0, 0.0]]) * LENGTH
TRUE_DRIFT = np.array([40.0, -30.0, 10.0]) * LENGTH
PATTERNS = {"residuals.sessions-differ", "residuals.trend", "residuals.drift"}


def save_with(path, data, *lines):
    """Save measurements with further settings, and return the path."""
    save_measurements(data, path, DELTA)
    text = path.read_text("utf-8")
    path.write_text("".join(f"# {line}\n" for line in lines) + text, "utf-8")
    return path


def measure_biased(seed=3):
    """Measure a delta in three sessions, each with its bias."""
    group = np.arange(30) % 3
    errors = draw_errors(30, 3, seed) + TRUE_BIAS[group] / LENGTH
    return measure(
        "linear-delta", "component", errors, seed, np.array(["mon", "tue", "wed"])[group]
    )


def measure_drifting(seed=3, order=None):
    """Measure a delta with a drift in time; rows are in this order of time."""
    order = np.arange(30) if order is None else order
    progress = order / 29.0 - 0.5
    errors = draw_errors(30, 3, seed) + progress[:, None] * TRUE_DRIFT / LENGTH
    context = {"time": 60.0 * order}
    return measure("linear-delta", "component", errors, seed, context=context)


def list_estimates(fit):
    """Return value and standard deviation of each setup parameter by name."""
    triples = zip(fit.nuisance.names, fit.nuisance.estimate, fit.nuisance.sd, strict=True)
    return {name: (value, sd) for name, value, sd in triples}


def test_a_session_bias_is_declared_in_one_line_and_estimated(tmp_path):
    truth, data = measure_biased()
    undeclared = load_measurements(save_with(tmp_path / "a.csv", data), DELTA)
    line = "session_bias: {x: 200 um, y: 200 um, z: 200 um}"
    declared = load_measurements(save_with(tmp_path / "b.csv", data, line), DELTA)
    before, fit = identify(DELTA, undeclared), identify(DELTA, declared)
    estimates = list_estimates(fit)
    assert len(estimates) == 9
    for i, session in enumerate(("mon", "tue", "wed")):
        for j, axis in enumerate("xyz"):
            value, sd = estimates[f"{session}.component.bias.{axis}"]
            assert abs(value - TRUE_BIAS[i, j]) < 4.0 * sd
            assert sd < 200e-6
    # it is cured: the residuals are those of the noise, and nothing depends on the session
    assert fit.residual_test.chi_square < 0.1 * before.residual_test.chi_square
    assert "residuals.sessions-differ" in {
        f.code for f in adjust_uncertainty(before, undeclared).findings
    }
    assert not PATTERNS & {f.code for f in adjust_uncertainty(fit, declared).findings}
    error, error_before = (np.linalg.norm(f.robot.values - truth) for f in (fit, before))
    assert error < error_before


def test_the_difference_of_two_sessions_is_stated_with_the_uncertainty_of_the_difference():
    session = np.repeat(["mon", "tue"], 15)
    errors = draw_errors(30, 3, 4)
    errors[:, 0] += np.where(session == "mon", 8.0, -8.0)
    _, data = measure("linear-delta", "component", errors, 4, session)
    (finding,) = (
        f
        for f in adjust_uncertainty(identify(DELTA, data), data).findings
        if f.code == "residuals.sessions-differ"
    )
    assert finding.data["component"] == "x"
    size, error = (finding.data[key].value for key in ("size", "error"))
    true = 8.0 * LENGTH * 1e3  # [mm]
    assert abs(abs(size) - true) < 4.0 * error
    assert error < 0.2 * true


@pytest.mark.parametrize("is_sorted", [True, False])
def test_a_drift_is_declared_in_one_line_and_estimated(tmp_path, is_sorted):
    order = np.arange(30) if is_sorted else np.random.default_rng(1).permutation(30)
    _, data = measure_drifting(order=order)
    path = save_with(tmp_path / "a.csv", data, "session_drift: unknown")
    declared = load_measurements(path, DELTA)
    fit = identify(DELTA, declared)
    for axis, true in zip("xyz", TRUE_DRIFT, strict=True):
        value, sd = list_estimates(fit)[f"component.drift.{axis}"]
        assert abs(value - true) < 4.0 * sd
        assert sd < 0.1 * np.abs(TRUE_DRIFT).max()
    assert "residuals.drift" in {
        f.code for f in adjust_uncertainty(identify(DELTA, data), data).findings
    }
    assert not PATTERNS & {f.code for f in adjust_uncertainty(fit, declared).findings}


def test_held_out_rows_have_the_drift_that_they_have_in_the_whole_session(tmp_path):
    _, data = measure_drifting()
    path = save_with(tmp_path / "a.csv", data, "session_drift: unknown")
    declared = load_measurements(path, DELTA)
    (rows,) = declared.observations
    half = declared.take(np.arange(5, 20))
    assert np.allclose(half.observations[0].drift_part, rows.drift_part[5:20])
    report = lc.calibrate(DELTA, declared, lc.CalibrationOptions(hold_out=0.3))
    assert report.validation is not None
    plain = lc.calibrate(DELTA, data, lc.CalibrationOptions(hold_out=0.3))
    codes = [{f.code for f in r.findings} for r in (report, plain)]
    assert "residuals.drift" in codes[1] - codes[0]
    assert report.verdict is not lc.Verdict.NOT_CALIBRATED


def test_components_without_a_line_have_no_bias_and_files_are_written_as_read(tmp_path):
    _, data = measure_biased()
    path = save_with(tmp_path / "a.csv", data, "session_bias: {x: 0.1 mm, z: unknown}")
    loaded = load_measurements(path, DELTA)
    table = loaded.nuisance_parameters.table
    found = {e.name: (e.free, e.tolerance) for e in table.entries}
    assert found["mon.component.bias.x"] == (True, pytest.approx(1e-4))
    assert found["mon.component.bias.y"][0] is False
    assert found["mon.component.bias.z"][0] is True
    assert found["mon.component.bias.z"][1] is None
    save_measurements(loaded, tmp_path / "b.csv", DELTA)
    again = load_measurements(tmp_path / "b.csv", DELTA).nuisance_parameters.table
    assert [(e.name, e.free) for e in again.entries] == [(e.name, e.free) for e in table.entries]
    assert np.array_equal(again.tolerance, table.tolerance, equal_nan=True)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("session_bias: yes", "Write 'session_bias: unknown'"),
        ("session_bias: {}", "Write 'session_bias: unknown'"),
        ("session_bias: {w: 1 um}", "'w'"),
        ("session_bias: {x: 5}", "unit"),
        ("session_bias: {x: 5 deg}", "deg"),
        ("session_drift: {x: 0 um}", "positive number"),
        ("session_drift: [x]", "Write 'session_drift: unknown'"),
    ],
)
def test_wrong_lines_are_refused_at_their_place(tmp_path, line, words):
    _, data = measure_biased()
    with pytest.raises(FileError, match=words) as caught:
        load_measurements(save_with(tmp_path / "a.csv", data, line), DELTA)
    assert "a.csv:1" in str(caught.value)


def test_a_bias_and_an_unknown_frame_together_begin_from_the_frame(tmp_path):
    errors = draw_errors(20, 9, 2) + (np.arange(20) / 19.0 - 0.5)[:, None] * np.tile(
        [30.0, 0, 0], 3
    )
    robot = ROBOTS["hexapod-42"]
    _, data = measure("hexapod-42", "tracker", errors, 2)
    (rows,) = data.observations
    kind = replace(rows.kind, unknown=("frame", "drift"))
    declared = replace(data, observations=(replace(rows, kind=kind),))
    fit = identify(robot, declared)
    value, sd = list_estimates(fit)["position.drift.x"]
    assert fit.converged
    assert abs(value - 30.0 * LENGTH) < 4.0 * sd
    assert sd < 10.0 * LENGTH


@pytest.mark.parametrize(
    "lines",
    [
        ["unknown: [offset]", "unknowns: {wire.offset: {sd: 0.2 mm}}"],
        ["unknown: [bias]", "unknowns: {wire.offset: {sd: 0.2 mm}}"],
        ["session_bias: {distance: 0.2 mm}"],
    ],
)
def test_offset_and_bias_of_a_distance_are_one_unknown(tmp_path, lines):
    settings = ["kind: distance", "anchor: [0 mm, 0 mm, 900 mm]", "anchor_name: wire"]
    settings += ["noise: {distance: 10 um}", *lines]
    head = "\n".join(f"# {line}" for line in settings)
    columns = "pose,q1 [mm],q2 [mm],q3 [mm],distance [mm]"
    rows = "\n".join(f"{i},{200 + i},{200 - i},205,{700 + i}" for i in range(4))
    path = tmp_path / "a.csv"
    path.write_text(f"{head}\n{columns}\n{rows}\n")
    (value,) = load_measurements(path, DELTA).stated_values
    assert (value.name, value.sd) == ("wire.offset", 2e-4)


WARM = "temperature: {value: 23 degC, sd: 1 K, expansion: 11.5 ppm/K"
FACTORS = {
    "scale: {sd: 25 ppm}": {"scale": (0.0, 25e-6)},
    "scale: {sd: 6 um/m, mean: -2 ppm}": {"scale": (-2e-6, 6e-6)},
    f"{WARM}}}": {"temperature": (34.5e-6, 11.5e-6)},
    f"{WARM}, expansion_sd: 1 ppm/K}}": {
        "temperature": (34.5e-6, 11.5e-6),
        "expansion": (0.0, np.sqrt(10.0) * 1e-6),  # hypot(3 K, 1 K) times 1 ppm/K
    },
    f"{WARM}, reference: 296.15 K}}": {"temperature": (0.0, 11.5e-6)},
    "temperature: {value: 77 degF, sd: 1.8 degF, expansion: 6 ppm/degF}": {
        "temperature": (5 * 10.8e-6, 10.8e-6)
    },
    "mpe: {constant: 15 um, per_length: 6 um/m}": {"scale": (0.0, 6e-6 / np.sqrt(3.0))},
    "mpe: {constant: 15 um}": {},
}


@pytest.mark.parametrize("line", FACTORS)
def test_scales_are_declared_in_one_line_for_each_session_and_written_as_read(tmp_path, line):
    _, data = measure_biased()
    path = save_with(tmp_path / "a.csv", data, line)
    if line.startswith("mpe"):
        lines = path.read_text("utf-8").splitlines(keepends=True)
        path.write_text("".join(x for x in lines if not x.startswith("# noise")), "utf-8")
    loaded = load_measurements(path, DELTA)
    table = loaded.nuisance_parameters.table
    found = {e.name: (e.nominal, e.tolerance) for e in table.entries}
    expected = {
        f"{session}.component.{item}": pytest.approx(of, rel=1e-9, abs=1e-18)
        for session in ("mon", "tue", "wed")
        for item, of in FACTORS[line].items()
    }
    assert found == expected
    (rows,) = loaded.observations
    sigma = 15e-6 / np.sqrt(3.0) if line.startswith("mpe") else LENGTH
    assert np.allclose(rows.covariance, sigma**2 * np.eye(3), rtol=1e-9, atol=0.0)
    save_measurements(loaded, tmp_path / "b.csv", DELTA)
    again = load_measurements(tmp_path / "b.csv", DELTA)
    assert again.nuisance_parameters.table == table
    assert again.observations[0].kind.unknown == rows.kind.unknown


@pytest.mark.parametrize(
    "lines",
    [
        ["scale: {sd: 2 ppm, scope: all}"],
        ["unknown: [scale]", "unknowns: {component.scale: {sd: 2 ppm, scope: all}}"],
    ],
)
def test_all_sessions_can_share_one_scale(tmp_path, lines):
    _, data = measure_biased()
    loaded = load_measurements(save_with(tmp_path / "a.csv", data, *lines), DELTA)
    (entry,) = loaded.nuisance_parameters.table.entries
    assert (entry.name, entry.tolerance) == ("component.scale", 2e-6)
    assert not loaded.nuisance_parameters.indices[0].any()
    save_measurements(loaded, tmp_path / "b.csv", DELTA)
    again = load_measurements(tmp_path / "b.csv", DELTA)
    assert again.nuisance_parameters.table.entries == (entry,)


def test_noise_that_is_stated_counts_before_that_of_an_mpe(tmp_path):
    _, data = measure_biased()
    path = save_with(tmp_path / "a.csv", data, "mpe: {constant: 15 um}")
    (rows,) = load_measurements(path, DELTA).observations
    assert np.allclose(rows.covariance, LENGTH**2 * np.eye(3), rtol=1e-9, atol=0.0)


def test_a_prior_without_a_session_holds_in_every_session_in_python(tmp_path):
    _, data = measure_biased()
    (rows,) = data.observations
    rows = replace(rows, kind=replace(rows.kind, unknown=("scale",)))
    stated = (lc.StatedValue("component.scale", 2e-6),)
    data = replace(data, observations=(rows,), stated_values=stated)
    expected = {f"{session}.component.scale": 2e-6 for session in ("mon", "tue", "wed")}
    save_measurements(data, tmp_path / "a.csv", DELTA)
    for each in (data, load_measurements(tmp_path / "a.csv", DELTA)):
        entries = each.nuisance_parameters.table.entries
        assert {e.name: e.tolerance for e in entries} == expected
    with pytest.raises(lc.DataError, match="the scope of 'a' is 'some'"):
        lc.StatedValue("a", 1.0, scope="some")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("scale: 2 ppm", "but must be a mapping. write 'key: value' lines with sd, limit, U"),
        ("scale: {}", "an uncertainty has one form: 'sd'"),
        ("scale: {mean: 2 ppm}", "an uncertainty has one form"),
        ("scale: {sd: 2}", "'2' has no unit. Add one of 1, ppm, um/m"),
        ("scale: {sd: 2 mm}", "not of a ratio. Allowed: 1, ppm, um/m"),
        ("scale: {sd: nan ppm}", "Write a finite number with a unit"),
        ("scale: {sd: -2 ppm}", "'sd' of 'scale' is -2 ppm; write a positive number"),
        ("scale: {sd: 2 ppm, sigma: 3 ppm}", "sigma"),
        ("scale: {sd: 2 ppm, scope: robot}", "'scale.scope' is 'robot'. Allowed: 'session', 'all'"),
        ("temperature: {value: 23 mm, sd: 1 K, expansion: 11.5 ppm/K}", "degC, K, degF"),
        ("temperature: {value: 23 degC, sd: 1 mm, expansion: 11.5 ppm/K}", "degC, K, degF"),
        ("temperature: {value: 23 degC, sd: 1 K, expansion: 11.5 ppm}", "ppm/K"),
        ("temperature: {value: 23 degC, sd: 1 K}", "has no key 'expansion'"),
        ("temperature: {value: -5 K, sd: 1 K, expansion: 11.5 ppm/K}", "below absolute zero"),
        ("mpe: {per_length: 6 um/m}", "has no key 'constant'"),
        ("mpe: {constant: -6 um}", "positive number"),
        ("mpe: {constant: 6 ppm}", "not of a length. Allowed: m, mm"),
    ],
)
def test_wrong_scales_are_refused_at_their_place(tmp_path, line, words):
    _, data = measure_biased()
    with pytest.raises(FileError, match=words) as caught:
        load_measurements(save_with(tmp_path / "a.csv", data, line), DELTA)
    assert "a.csv:1" in str(caught.value)


def test_scale_that_is_known_exactly_has_no_uncertainty(tmp_path):
    _, data = measure_biased()
    loaded = load_measurements(
        save_with(tmp_path / "a.csv", data, "scale: {mean: 2 ppm, sd: 0 ppm}"), DELTA
    )
    scales = {value for value in loaded.stated_values if value.name.endswith("scale")}
    assert {(value.nominal, value.sd) for value in scales} == {(2e-6, 0.0)}


def test_contradictions_of_scales_are_refused(tmp_path):
    _, data = measure_biased()
    lines = ["mpe: {constant: 6 um, per_length: 2 ppm}", "scale: {sd: 2 ppm}"]
    with pytest.raises(FileError, match=r"both define the scale of the instrument. Remove one"):
        load_measurements(save_with(tmp_path / "a.csv", data, *lines), DELTA)
    lines = ["scale: {sd: 2 ppm, scope: all}", "unknowns: {mon.component.scale: {sd: 5 ppm}}"]
    with pytest.raises(FileError, match="has the scope all in another line or file"):
        load_measurements(save_with(tmp_path / "a.csv", data, *lines), DELTA)


@pytest.mark.parametrize("key", ["scale", "temperature", "mpe"])
def test_angles_have_no_scale(tmp_path, key):
    text = f"# kind: inclination\n# noise: {{'*': 5 urad}}\n# {key}: {{sd: 2 ppm}}\n"
    path = tmp_path / "a.csv"
    path.write_text(text + "q1 [mm],q2 [mm],q3 [mm],tilt_x [mrad],tilt_y [mrad]\n200,200,200,1,2\n")
    with pytest.raises(FileError, match=f"'inclination' measures no lengths. Remove '{key}'"):
        load_measurements(path, DELTA)


def test_a_warm_machine_is_corrected_to_the_reference_temperature(tmp_path):
    """Lengths measured at 23 degC are 34.5 ppm longer than those of the robot file."""
    gantry = lc.load_robot("core-xy")
    truth = gantry.with_values(sample_truth(gantry, 1, 2)[0])
    poses = sample_workspace(gantry, 30, 2).coordinates
    sensor = lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 1e-6)))
    cold = lc.simulate(truth, poses, lc.Instrument((sensor,)), 2)
    (rows,) = cold.observations
    warm = replace(cold, observations=(replace(rows, measured=rows.measured * (1.0 + 34.5e-6)),))
    save_measurements(warm, tmp_path / "warm.csv", gantry)
    text = (tmp_path / "warm.csv").read_text("utf-8")
    line = "temperature: {value: 23 degC, sd: 0.001 K, expansion: 11.5 ppm/K}"
    (tmp_path / "warm.csv").write_text(f"# {line}\n{text}", "utf-8")
    gains = [
        dict(zip(fit.robot.parameters.names, fit.robot.values, strict=True))["z.gain"]
        for fit in (
            identify(gantry, cold),
            identify(gantry, warm),
            identify(gantry, load_measurements(tmp_path / "warm.csv", gantry)),
        )
    ]
    assert gains[1] - gains[0] == pytest.approx(34.5e-6, rel=0.05)
    assert gains[2] - gains[0] == pytest.approx(0.0, abs=0.1e-6)


def test_a_simulation_draws_the_scale_of_each_machine_from_the_prior_of_the_file(tmp_path):
    path = tmp_path / "like.csv"
    settings = ["kind: position", "noise: {'*': 1 nm}", "mpe: {constant: 1 um, per_length: 90 ppm}"]
    path.write_text("".join(f"# {line}\n" for line in settings) + "q1 [mm]\n1\n", "utf-8")
    instrument = load_instrument(path, DELTA)
    poses, sd = sample_workspace(DELTA, 2, 1).coordinates, 90e-6 / np.sqrt(3.0)
    truth = np.repeat(DELTA.values[None], 2000, axis=0)
    trials = simulate_trials(DELTA, truth, poses, instrument, 1)
    scale = (trials.measured[0] / trials.T[..., :3, 3])[:, 0, 2] - 1.0
    assert abs(scale.mean()) < 4.0 * sd / np.sqrt(2000)
    assert scale.std() == pytest.approx(sd, rel=4.0 / np.sqrt(4000))
    assert trials.trial(7).nuisance_parameters.table.tolerance == pytest.approx([sd])
    known = simulate_trials(
        DELTA, truth[:2], poses, instrument, 1, nuisance_values={"position.scale": 1e-3}
    )
    expected = 1.001 * known.T[..., :3, 3]
    assert known.measured[0] == pytest.approx(expected, abs=6e-9)  # [m], six sigma


def test_all_sessions_can_share_the_offset_of_a_bar_but_no_frame(tmp_path):
    rows = lc.Observations.from_sigma(
        lc.Separation(unknown=("offset",)).with_tool(DELTA.tool),
        np.array([[0, 1], [1, 2]]),
        np.full((2, 1), 0.1),
        1e-6,
        np.array(["mon", "tue"]),
    )
    stated = (lc.StatedValue("separation.offset", np.inf, scope="all"),)
    data = measure_biased()[1].take(np.arange(3))
    data = replace(data, observations=(rows,), stated_values=stated)
    save_measurements(data, tmp_path / "a.csv", DELTA)
    for each in (data, load_measurements(tmp_path / "a.csv", DELTA)):
        (entry,) = each.nuisance_parameters.table.entries
        assert (entry.name, entry.tolerance) == ("separation.offset", None)
    _, tracked = measure("hexapod-42", "tracker", draw_errors(5, 9, 2), 2)
    path = tmp_path / "b.csv"
    save_measurements(tracked, path, ROBOTS["hexapod-42"])
    text = path.read_text("utf-8")
    path.write_text("# unknowns: {frame.x: {scope: all}}\n" + text, "utf-8")
    with pytest.raises(
        lc.LoopcalError, match=r"of 'frame\.x' is all, but sessions share only offsets"
    ):
        load_measurements(path, ROBOTS["hexapod-42"])


def test_a_contradicted_scale_of_all_sessions_is_named_with_its_value():
    session = np.repeat(["mon", "tue"], 20)
    _, data = measure("linear-delta", "component", draw_errors(40, 3, 1), 1, session)
    (rows,) = data.observations
    kind = replace(rows.kind, unknown=("scale",))
    rows = replace(rows, kind=kind, measured=1.003 * rows.measured)
    stated = (lc.StatedValue("component.scale", 2e-6, scope="all"),)
    data = replace(data, observations=(rows,), stated_values=stated)
    text = str(lc.check_conventions(DELTA, data).finding)
    assert re.search(r"put component.scale at (299|300)\d ppm", text)
    assert "not at 0 ppm (sd 2 ppm)" in text


def test_units_of_files_do_not_matter_to_a_scale(tmp_path):
    gantry = lc.load_robot("core-xy")
    sensor = lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 1e-6)))
    poses = sample_workspace(gantry, 20, 2).coordinates
    data = lc.simulate(gantry, poses, lc.Instrument((sensor,)), 2)
    save_measurements(data, tmp_path / "mm.csv", gantry)
    lines = (tmp_path / "mm.csv").read_text("utf-8").splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("pose,"))
    columns = lines[head].split(",")
    rows = [line.split(",") for line in lines[head + 1 :]]
    for j, name in enumerate(columns):
        if name.endswith("[mm]"):
            columns[j] = name.replace("[mm]", "[m]")
            for row in rows:
                row[j] = repr(float(row[j]) / 1000.0)
    meters = "\n".join([*lines[:head], *(",".join(r) for r in [columns, *rows])]) + "\n"
    (tmp_path / "m.csv").write_text("# scale: {sd: 2.5e-5 1}\n" + meters, "utf-8")
    (tmp_path / "mm.csv").write_text("# scale: {sd: 25 um/m}\n" + "\n".join(lines) + "\n", "utf-8")
    fits = [
        identify(gantry, load_measurements(tmp_path / f"{name}.csv", gantry))
        for name in ("mm", "m")
    ]
    sd = fits[0].standard_deviations
    # a fit ends where a step changes residuals by a millionth of their norm, 7e-6 deviations here
    assert (np.abs(fits[0].estimate - fits[1].estimate) <= 1e-5 * sd).all()
    assert np.allclose(sd, fits[1].standard_deviations, rtol=1e-6)
    # the gantry does not know its size, and residuals below the noise say nothing of it
    assert fits[1].residual_test.sigma_scale < 0.97
    assert fits[1].nuisance.sd[0] == pytest.approx(25e-6, rel=0.01)
