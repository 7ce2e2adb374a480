# SPDX-License-Identifier: Apache-2.0
"""Heights that Marlin and RepRapFirmware report lead to the true geometry, with the right sign."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.geometry import align_point_sets, log_so3
from loopcal.mechanism.solutions import forward, inverse

MARLIN = "M665 L220.00 R105.00 H300.00 X0.00 Y0.00 Z0.00\nM666 X-0.10 Y0.00 Z-0.20\n"
REPRAP = "M665 L220:220:220 R105 H300 X0 Y0 Z0 B85\nM666 X0.1 Y-0.1 Z0\n"
TRUE = {"radius": 0.5e-3, "tower1.angle": 0.003, "tower2.angle": -0.002, "tower1.stop": -0.2e-3}
TRUE |= {"tower2.stop": 0.15e-3, "tower3.stop": 0.1e-3}
"""Deviations of the true printer from what its firmware knows [SI]."""


def list_ring(radius: float, first: float) -> list[tuple[float, float]]:
    """Return six points of a circle [mm], the first one at this angle [deg]."""
    angles = [math.radians(first + 60.0 * k) for k in range(6)]
    return [(radius * math.cos(a), radius * math.sin(a)) for a in angles]


POINTS = [(0.0, 0.0), *list_ring(35.0, 0.0), *list_ring(70.0, 30.0)]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("m503.gcode").write_text(MARLIN)
    Path("config.g").write_text(REPRAP)
    return tmp_path


def run(words: str) -> int:
    return main(words.split())


def make_truth(config: str, name: str = "truth.yaml"):
    """Return the robot of the firmware and the true printer."""
    assert run(f"import {config} -o {name} --force") == 0
    robot = lc.load_robot(name)
    change = np.array([TRUE.get(parameter, 0.0) for parameter in robot.parameters.names])
    return robot, robot.with_values(robot.values + change)


def probe(robot, truth, points, offset=(0.0, 0.0)) -> list[float]:
    """Return the heights [mm] that a firmware reports: it lowers the nozzle by its own geometry
    until the nozzle truly touches the bed.
    """
    places = np.zeros((len(points), 3))
    places[:, :2] = 1e-3 * (np.array(points) - offset)
    for _ in range(30):
        places[:, 2] -= forward(truth, inverse(robot, places).q).T[:, 2, 3]
    return (1e3 * places[:, 2]).tolist()


G30 = ("{}", "Bed X:{x:.2f} Y:{y:.2f} Z:{h:.3f}\nok\nX:{x:.2f} Y:{y:.2f} Z:10.00 E:0 Count X:1\n")
M114 = ("{}", "X:{x:.2f} Y:{y:.2f} Z:{h:.3f} E:0.00 Count X:100 Y:200 Z:300\n")
G32, BED = (
    ("G32 bed probe heights:{}, mean 0, deviation 0", " {h:.3f}"),
    "G30 P{i} X{x:.3f} Y{y:.3f} Z-99999 . Point\n",
)
OLD = (
    "M561\nBed probe heights: 0.000 0.000\nBed probe heights:{}, mean 0, deviation 0",
    " {h:.3f}",
)
"""Before RepRapFirmware 2.0, below the five heights of M122."""
STOPPED = "Stopped at height {s:.3f} mm\nok\n"
MACRO = "G1 X{x:.3f} F6000\nG1 Y{y:.3f}\nG30 S-1\n"
G31, M851 = "G31 P500 X15 Y5 Z2.5 ; inductive probe\n", "M851 X20.00 Y-10.00 Z-1.50\n"


def write_points(points, heights, file="report.txt", text=G30[0], line=G30[1]) -> None:
    """Write a text with a line for each point."""
    rows = enumerate(zip(points, heights, strict=True))
    lines = "".join(line.format(i=i, x=x, y=y, h=h, s=h + 2.5) for i, ((x, y), h) in rows)
    Path(file).write_text(text.format(lines))


def check_calibration(words: str, truth, tolerance: float = 6e-6) -> None:
    """Import and calibrate; the identified parameters are the true ones."""
    assert run(f"import {words} -o printer.yaml --data heights.csv --force") == 0
    assert run("calibrate printer.yaml heights.csv -o run --method ls --force") in (0, 2)
    robot = lc.load_run("run").robot
    free = robot.parameters.free
    errors = np.abs(robot.values - truth.values)[free]
    sizes = [
        tolerance if "angle" not in n else 5e-5 for n in np.array(robot.parameters.names)[free]
    ]
    assert (errors < sizes).all(), errors


REPORTS = {
    "G30": (MARLIN, (0.0, 0.0), {"report.txt": G30}),
    "probe beside the nozzle": (MARLIN + M851, (20.0, -10.0), {"report.txt": G30}),
    "touches by hand": (MARLIN, (0.0, 0.0), {"m114.txt": M114}),
    "G32": (REPRAP, (0.0, 0.0), {"report.txt": G32, "bed.g": ("M561\n{} S6\n", BED)}),
    "before 2.0": (REPRAP, (0.0, 0.0), {"report.txt": OLD, "bed.g": ("M561\n{} S-1\n", BED)}),
    "G30 S-1": (REPRAP + G31, (0.0, 0.0), {"report.txt": ("{}", MACRO + STOPPED)}),
    "G30 S-1 of a macro": (
        REPRAP + G31,
        (0.0, 0.0),
        {"report.txt": ("{}", STOPPED), "probe.g": ("G28\n{}M84\n", MACRO)},
    ),
    "probe in another file": (
        REPRAP,
        (15.0, 5.0),
        {"report.txt": G32, "bed.g": ("{}", BED.replace(" ", "").lower()), "probe.g": (G31, "")},
    ),
}
"""Configuration, offset of the probe [mm], and the files of the heights that it reports."""


@pytest.mark.parametrize("name", REPORTS)
def test_reported_heights_lead_to_the_truth(name: str, capsys) -> None:
    text, offset, files = REPORTS[name]
    config = "m503.gcode" if text.startswith(MARLIN) else "config.g"
    Path(config).write_text(text)
    robot, truth = make_truth(config)
    heights = probe(robot, truth, POINTS, offset)
    assert np.ptp(heights) > 0.1
    for file, form in files.items():
        write_points(POINTS, heights, file, *form)
    capsys.readouterr()
    check_calibration(" ".join([config, *(f"--probes {file}" for file in files)]), truth)
    place = f"The probe is at x {offset[0]:g} mm, y {offset[1]:g} mm from the nozzle"
    assert (place in " ".join(capsys.readouterr().out.split())) == any(offset)


def test_a_height_entered_as_z_would_move_the_radius_in_the_wrong_direction() -> None:
    """Why the import exists: commanded readings with the reported height as z."""
    robot, truth = make_truth("m503.gcode")
    heights = np.array(probe(robot, truth, POINTS))
    write_points(POINTS, heights)
    assert run("import m503.gcode --probes report.txt -o printer.yaml --data heights.csv") == 0
    text = Path("heights.csv").read_text()
    place = robot.parameters.names.index("radius")
    results = []
    for sign in (1.0, -1.0):
        at_zero = 1e-3 * np.array([[x, y, 0.0] for x, y in POINTS])
        readings = 1e3 * inverse(robot, at_zero).q
        head = [line for line in text.splitlines() if line.startswith("#")]
        rows = [
            ",".join([str(i), *(f"{q:.5f}" for q in row), f"{sign * h:.4f}"])
            for i, (row, h) in enumerate(zip(readings, heights, strict=True))
        ]
        Path("by-hand.csv").write_text(
            "\n".join([*head, "pose,q1 [mm],q2 [mm],q3 [mm],z [mm]", *rows])
        )
        run("calibrate printer.yaml by-hand.csv -o hand --method ls --force")
        results.append(lc.load_run("hand").robot.values[place] - robot.values[place])
    assert results[0] < -0.3e-3  # the wrong direction
    assert results[1] == pytest.approx(TRUE["radius"], abs=0.05e-3)


def test_a_dry_run_of_g33_leads_to_the_truth() -> None:
    robot, truth = make_truth("m503.gcode")
    angles = {"x": 210, "y": 330, "z": 90, "yz": 30, "zx": 150, "xy": 270}
    lines = []
    for radius in (50.0, 80.0):
        turns = [math.radians(angle) for angle in angles.values()]
        points = [(0.0, 0.0), *((radius * math.cos(a), radius * math.sin(a)) for a in turns)]
        h = dict(zip(("c", *angles), probe(robot, truth, points), strict=True))
        lines += [
            "G33 Auto Calibrate",
            f"Checking... AC at radius:{radius:.2f} (DRY-RUN)",
            ".Height:300.00  Ex:-0.10  Ey:+0.00  Ez:-0.20  Radius:105.00",
            ".             Tx:+0.00  Ty:+0.00  Tz:+0.00",
            f".      c:{h['c']:+.3f}   x:{h['x']:+.3f}   y:{h['y']:+.3f}   z:{h['z']:+.3f}",
            f".             yz:{h['yz']:+.3f}  zx:{h['zx']:+.3f}  xy:{h['xy']:+.3f}",
            "End DRY-RUN                                   std dev:0.210",
        ]
    Path("g33.txt").write_text("\n".join(lines))
    check_calibration("m503.gcode --probes g33.txt", truth)


@pytest.mark.slow
def test_a_height_map_of_reprapfirmware() -> None:
    robot, truth = make_truth("config.g")
    grid = [(-60 + 30 * k, -60 + 30 * j) for j in range(5) for k in range(5)]
    heights = probe(robot, truth, grid)
    cells = ["0" if math.hypot(*p) > 75 else f"{h:.3f}" for p, h in zip(grid, heights, strict=True)]
    rows = [", ".join(cells[5 * j : 5 * j + 5]) for j in range(5)]
    head = "RepRapFirmware height map file v2 generated at 2026-01-01 10:00, min error 0"
    for titles, first in (
        ("axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1", "X,Y,"),
        ("xmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum", ""),
    ):
        stated = f"{first}-60.00,60.00,-60.00,60.00,75.00,30.00,30.00,5,5"
        Path("heightmap.csv").write_text("\n".join([head, titles, stated, *rows]) + "\n")
        check_calibration("config.g --probes heightmap.csv", truth)
        assert lc.load_run("run").result["fit"]["dof"] > 0
    Path("heightmap.csv").write_text("\n".join([head, titles, stated, *rows[:-1]]))
    assert run("import config.g --probes heightmap.csv -o p.yaml --data h.csv") == 1


@pytest.mark.parametrize(
    ("config", "report", "words"),
    [
        ("m503.gcode", "ok\nBed X:0 Y:0 Z:0.1\n", "1 probed height, but six numbers"),
        ("m503.gcode", "hello\n", "contains no probe report of Marlin"),
        ("config.g", "hello\n", "contains no probe report of RepRapFirmware"),
        ("m503.gcode", "Checking... AC at radius:80.00\n.  c:+0.1\n", "is not a dry run"),
        ("m503.gcode", "Checking... AC (DRY-RUN)\n.  c:+0.1\n", "lacks the radius"),
        ("config.g", "G32 bed probe heights: 0.1 not set 0.2, mean 1\n", "failed to probe a point"),
        ("config.g", "G32 bed probe heights: 0.1 0.2, mean 1\n", "contain no G30 P0"),
        ("m503.gcode", "Bed X: 1,00 Y: 2,00 Z: 0,107\n", "report.txt:1: loopcal cannot read"),
        ("m503.gcode", "ok\nBed X: 1.00 Y: 2.00 Z: 0,107\n", "report.txt:2: loopcal cannot"),
        (
            "m503.gcode",
            "ok\nBed X: 1.00 Y: 2.\n",
            "read this probed point: 'Bed X: 1.00 Y: 2.'. Marlin",
        ),
        ("m503.gcode", "X:1,0 Y:2,0 Z:0,1 E:0,0 Count X:1\n", "with decimal points"),
        ("config.g", "G32 bed probe heights: 0,1 0,2, mean 1\n", "of this G32: '0,1 0,2'"),
        ("config.g", "G1 X0 Y0\nG30 S-1\nStopped at height 2.1 mm\n", "the files lack (G31 Z..)"),
        ("config.g", "G31 Z2\nG30 S-1\nStopped at height 2 mm\nG1 X0 Y0\n", "its point is unknown"),
        (
            "config.g",
            "G31 Z2\n" + 2 * "G1 X0 Y0\nG30 S-1\n" + "Stopped at height 2 mm\n",
            "report.txt:3: The log has no 'Stopped at height ..' for this G30",
        ),
        (
            "config.g",
            "G31 Z2\nG1 X0 Y0\nG30 S-1\n" + 2 * "Stopped at height 2 mm\n",
            "has 2 heights, but the files have 1 point",
        ),
        ("config.g", "Stopped at height 2,153 mm\n", "report.txt:1: loopcal cannot read"),
        ("config.g", "Stopped at height 2153\n", "'Stopped at height 2.153 mm' with"),
        (
            "config.g",
            "Calibrated 6 factors using 13 points, deviation\n",
            "Replace S6 at the end of bed.g",
        ),
        ("config.g", "Bed probe heights: 0.000 0.000 0.000 0.000 0.000\n", "no probe report"),
        ("m503.gcode", 9 * "Bed X:1 Y:2 Z:0\nBed X:1 Y:2 Z:319\n", "Are they in micrometers?"),
        (
            "config.g",
            "G30 P0 X0 Y0\nG30 P1 X9 Y0\nG30 P2 X0 Y9\nG32 bed probe heights: 0.1 0.2, mean 1\n",
            "report.txt:4: The answer has 2 heights, but the files have 3 points",
        ),
        ("config.g", "RepRapFirmware height map file v2\nx\n", "differ from its header"),
    ],
)
def test_reports_that_cannot_be_used_are_refused(config, report, words, capsys) -> None:
    Path("report.txt").write_text(report)
    assert run(f"import {config} --probes report.txt -o p.yaml --data h.csv") == 1
    assert words in " ".join(capsys.readouterr().err.split())
    assert not Path("p.yaml").exists()


def test_a_point_out_of_reach_is_named(capsys) -> None:
    points = [*POINTS[:-1], (5000.0, 0.0)]
    write_points(points, [0.0] * len(points))
    assert run("import m503.gcode --probes report.txt -o p.yaml --data h.csv") == 1
    assert f"the probed point {len(points)}" in " ".join(capsys.readouterr().err.split())


def test_probes_do_not_belong_to_klipper(capsys) -> None:
    Path("printer.cfg").write_text("[printer]\nkinematics: delta\n")
    Path("report.txt").write_text("")
    assert run("import printer.cfg --probes report.txt -o p.yaml") == 1
    assert "--probes does not belong to the format klipper" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words"),
    [("printer.cfg", "a configuration file of Klipper"), ("config.g", "of RepRapFirmware")],
)
def test_calibrate_says_what_to_type_for_a_configuration(name, words, capsys) -> None:
    Path(name).write_text("[printer]\nkinematics: delta\n")
    assert run(f"calibrate {name} heights.csv -o run") == 1
    err = " ".join(capsys.readouterr().err.split())
    assert words in err
    assert "type loopcal import FILE -o printer.yaml --data heights.csv" in err
    assert "then loopcal calibrate printer.yaml heights.csv -o run" in err


def test_one_wrong_height_is_an_outlier_and_no_target_that_stands_still(capsys) -> None:
    robot, truth = make_truth("m503.gcode")
    heights = probe(robot, truth, POINTS)
    write_points([*POINTS, (10.0, -20.0)], [*heights, 9.999])
    words = "--probes report.txt -o printer.yaml --data heights.csv --sigma-height 0.02mm"
    assert run(f"import m503.gcode {words}") == 0
    assert run("calibrate printer.yaml heights.csv -o run") == 2
    captured = capsys.readouterr()
    assert "never moves" not in captured.err
    assert "Pose 14" in captured.out


@pytest.mark.parametrize(
    ("config", "shift", "spread", "words"),
    [
        (REPRAP + "G31 P500 X0 Y0 Z-2.1\n", 4.2, 0.1, "twice Z-2.1 of the file: its sign"),
        (REPRAP + "G31 P500 X0 Y0 Z2.1\n", 3.0, 0.1, "shift of 3 mm, and differ by 0"),
        (REPRAP + "G31 P500 Z2.1\n", 0.5, 0.1, "The files lack X and Y of G31"),
        (MARLIN + "M851 X0 Y0 Z1.4\n", 2.8, 0.1, "twice Z1.4 of the file: its sign"),
        (
            MARLIN + "M851 X0 Y0 Z-1.4\n",
            120.0,
            0.1,
            "The heights range from 120 mm to 120 mm. Are they in",
        ),
        (
            MARLIN + "M851 X0 Y0 Z-1.4\n",
            0.0,
            4.0,
            "from -4 mm to 3.96 mm. Are they in micrometers?",
        ),
    ],
)
def test_what_heights_cannot_show_of_the_probe_is_said(
    config, shift, spread, words, capsys
) -> None:
    file = "config.g" if config.startswith(REPRAP) else "m503.gcode"
    Path(file).write_text(config)
    heights = [shift + spread * np.sin(k) for k in range(len(POINTS))]
    write_points(POINTS, heights, "report.txt", *(G32 if file == "config.g" else G30))
    write_points(POINTS, heights, "bed.g", "{}", BED)
    more = "--probes bed.g" if file == "config.g" else ""
    assert run(f"import {file} --probes report.txt {more} -o p.yaml --data h.csv") == 0
    assert words in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("front", ["Recv: echo:  ", "[10:12:31] >>> ", "2026-11-30 10:12:31,5 - "])
def test_a_terminal_may_write_times_and_directions_in_front_of_the_configuration(front) -> None:
    robot, truth = make_truth("m503.gcode")
    write_points(POINTS, probe(robot, truth, POINTS))
    Path("m503.gcode").write_text("".join(f"{front}{line}\n" for line in MARLIN.splitlines()))
    assert run("import m503.gcode --probes report.txt -o p.yaml --data h.csv") == 0
    np.testing.assert_array_equal(lc.load_robot("p.yaml").values, robot.values)


@pytest.mark.parametrize(
    ("stored", "times", "change", "words"),
    [
        (
            "",
            ("", ""),
            0.3,
            "13 points were probed several times. The heights of one differ by 0.3",
        ),
        ("", ("2026-11-30 09:40:01 ", "2026-12-02 08:00:00 "), 0.0, "from 2026-11-30 and 2026-12"),
        (
            "; M500 at 2026-11-30 10:15\n",
            2 * ("2026-11-30 09:40:01 ",),
            0.0,
            "from 2026-11-30 10:15",
        ),
        ("", ("M665 L220 R104.1\n", ""), 0.0, "a.txt has other numbers than an earlier"),
        ("; M500 at 2026-11-29 10:15\n", 2 * ("2026-11-30 09:40:01 ",), 0.0, ""),
        ("; M500 at 2026-11-30T08:15\n", 2 * ("2026-11-30 09:40:01 ",), 0.0, ""),
    ],
)
def test_runs_that_may_belong_to_other_numbers_are_named(
    stored, times, change, words, capsys
) -> None:
    Path("m503.gcode").write_text(stored + MARLIN + "M851 X0 Y0 Z0\n")
    heights = [0.1 * np.sin(k) for k in range(len(POINTS))]
    write_points(POINTS, heights, "a.txt", "{}", times[0] + G30[1])
    write_points(POINTS, [h + change for h in heights], "b.txt", "{}", times[1] + G30[1])
    assert run("import m503.gcode --probes a.txt --probes b.txt -o p.yaml --data h.csv") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert words in out
    assert words or not any(text in out for text in ("several times", "from 2026", "M665 R"))


def test_end_stops_that_a_file_lacks_are_assumed_and_all_are_written(capsys) -> None:
    Path("m503.gcode").write_text(MARLIN.splitlines()[0] + "\n")
    _, truth = make_truth("m503.gcode")
    assert "lacks M666" in " ".join(capsys.readouterr().out.split())
    lc.save_robot(truth, "true.yaml")
    assert run("export true.yaml --format marlin --into m503.gcode -o new.gcode") == 0
    words = Path("new.gcode").read_text().splitlines()[-1].split()
    assert [word[:1] for word in words] == ["M", "X", "Y", "Z"]


def test_a_report_in_place_of_the_configuration_is_named(capsys) -> None:
    write_points(POINTS, [0.0] * len(POINTS))
    assert run("import report.txt --probes config.g -o p.yaml --data h.csv") == 1
    assert "This is a probe report" in capsys.readouterr().err


def test_a_wrong_height_is_named_with_the_option_that_leaves_it_out(capsys) -> None:
    """The noise is assumed, so the wrong height makes all intervals wide."""
    robot, truth = make_truth("m503.gcode")
    heights = probe(robot, truth, POINTS)
    heights[6] += 0.6
    write_points(POINTS, heights)
    assert run("import m503.gcode --probes report.txt -o p.yaml --data h.csv") == 0
    capsys.readouterr()
    assert run("calibrate p.yaml h.csv") == 0
    screen = capsys.readouterr().out
    assert "Hint: use --drop 7, or --loss huber" in screen
    assert screen.count("--drop 7") == 1
    sentences = [s for s in " ".join(screen.split()).split(". ") if len(s.split()) > 3]
    assert len(sentences) == len(set(sentences))  # nothing is said twice


def test_joined_logs_without_dates_are_named_as_a_cause(capsys) -> None:
    """As text of the import, and as a warning where the residuals exceed the noise."""
    robot, truth = make_truth("m503.gcode")
    for name, shift in (("a", 0.0), ("b", 0.4)):  # an end stop moved in between
        moved = truth.with_values(truth.values + 1e-3 * shift * make_stop(robot))
        write_points(POINTS, probe(robot, moved, POINTS), f"{name}.txt")
        words = f"import m503.gcode --probes {name}.txt -o p.yaml --data {name}.csv --force"
        assert run(f"{words} --sigma-height 0.01mm") == 0
        assert "without dates" not in capsys.readouterr().out
    assert run("import m503.gcode --probes a.txt --probes b.txt -o q.yaml --data q.csv") == 0
    words = "Several files without dates measure the same."
    assert words in " ".join(capsys.readouterr().out.split())
    text = Path("b.csv").read_text().splitlines()
    Path("b.csv").write_text("\n".join("b" + r if r[0].isdigit() else r for r in text))
    assert run("calibrate p.yaml a.csv b.csv -o run") == 2
    assert f"warning {words}" in " ".join(capsys.readouterr().out.split())
    assert run("calibrate p.yaml a.csv -o run2 --verbose") == 0
    assert words not in " ".join(capsys.readouterr().out.split())


def make_stop(robot) -> np.ndarray:
    """Return the change of the first end stop by 1 m."""
    return np.array([float(name == "tower1.stop") for name in robot.parameters.names])


def test_height_maps_of_two_days_are_named(capsys) -> None:
    Path("config.g").write_text(REPRAP + "G31 X0 Y0 Z1\n")
    titles = "xmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum\n-30,30,-30,30,45,30,30,3,3\n"
    for name, day, h in (("a", "2026-05-04", 0.1), ("b", "2026-05-31", 0.2)):
        rows = "".join(f"{h},{h + 0.01 * j},{h + 0.02 * j}\n" for j in range(3))
        head = f"RepRapFirmware height map file v2 generated at {day} 10:00, min error 0\n"
        Path(f"{name}.csv").write_text(head + titles + rows)
    assert run("import config.g --probes a.csv --probes b.csv -o p.yaml --data h.csv") == 0
    assert "are from 2026-05-04 and 2026-05-31" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("slope", "shift", "words"),
    [
        (4e-3, 0.0, "Check whether the bed is square to the machine before you apply values"),
        (0.0, 4.2, "Check the zero of the probe before you apply values"),
        (4e-3, 4.2, "Check the zero of the probe and whether the bed is square to the machine"),
    ],
)
def test_values_are_not_recommended_where_bed_or_probe_explain_heights_alone(
    slope, shift, words, capsys
) -> None:
    """The numbers of the firmware are right: its heights are those of the bed and of the probe."""
    noise = np.random.default_rng(1).normal(0.0, 0.015, len(POINTS))
    write_points(POINTS, [shift + slope * x + e for (x, _), e in zip(POINTS, noise, strict=True)])
    line = "--probes report.txt -o printer.yaml --data heights.csv --sigma-height 0.015mm"
    assert run(f"import m503.gcode {line}") == 0
    assert run("calibrate printer.yaml heights.csv -o run") == 0
    captured = capsys.readouterr()
    assert f"Recommendation: {words}" in " ".join(captured.out.split())
    assert ("first check the trigger height" in " ".join(captured.err.split())) == bool(shift)
    assert run("export run --format marlin") == 0
    noted = " ".join(capsys.readouterr().err.split())
    assert f"does not recommend these values. {words}" in noted
    if slope:
        codes = {f["code"]: f for f in lc.load_run("run").result["findings"]}
        assert codes["workflow.height-tilt"]["data"]["tilt"]["value"] == pytest.approx(4.0, abs=0.4)


def test_values_that_turn_the_base_frame_are_named_and_others_keep_it(capsys) -> None:
    """Two rods are wrong, which heights explain by towers that are turned against tower 3."""
    robot, _ = make_truth("config.g")
    names = list(robot.parameters.names)
    wrong = robot.values.copy()
    wrong[[names.index("arm1.length"), names.index("arm2.length")]] += [5e-3, -5e-3]
    heights = probe(robot, robot.with_values(wrong), POINTS)
    write_points(POINTS, heights, "report.txt", *G32)
    write_points(POINTS, heights, "bed.g", "{}", BED)
    line = "--probes report.txt --probes bed.g -o printer.yaml --data heights.csv"
    assert run(f"import config.g {line}") == 0
    assert run(f"import config.g {line} --corrected written.g --force") in (0, 2)
    assert "These values turn all of a program by 1." in " ".join(capsys.readouterr().out.split())
    assert run("calibrate printer.yaml heights.csv -o run --noise estimated") in (0, 2)
    lc.save_report(lc.load_run("run"), "run.html")
    assert "These values turn all of a program by 1." in Path("run.json").read_text()
    assert run("export run --format reprap -o new.g --force") in (0, 2)
    assert "These values turn all of a program by 1." in " ".join(capsys.readouterr().out.split())
    assert run("export run --format reprap -o kept.g --keep-frame --force") in (0, 2)
    told = " ".join(capsys.readouterr().out.split())
    assert "Set the origin of programs and the tool again" in told
    assert "--keep-frame" not in told
    targets = 1e-3 * np.array([[x, y, 0.0] for x, y in POINTS])
    readings, turns, heights = inverse(robot, targets).q, [], []
    for name in ("new", "kept"):
        assert run(f"import {name}.g -o {name}.yaml") == 0
        places = forward(lc.load_robot(f"{name}.yaml"), readings).T[:, :3, 3]
        motion = align_point_sets(places * [1, 1, 0], targets)
        turns.append(math.degrees(log_so3(motion[:3, :3])[2]))
        heights.append(places[:, 2])
    assert abs(turns[0]) > 1.0
    assert abs(turns[1]) < 0.2 * abs(turns[0])  # of the bed alone; it is zero over all heights
    np.testing.assert_allclose(heights[0], heights[1], atol=2e-6)  # [m], M665 has 0.001 mm


def test_heights_of_an_own_file_in_micrometers_are_named_as_possible(capsys) -> None:
    robot, truth = make_truth("config.g")
    at_zero = 1e-3 * np.array([[x, y, 0.0] for x, y in POINTS])
    readings = inverse(robot, at_zero).q
    heights = 1e6 * forward(truth, readings).T[:, 2, 3]
    rows = [
        ",".join([str(i), *(f"{1e3 * q:.5f}" for q in row), f"{h:.0f}"])
        for i, (row, h) in enumerate(zip(readings, heights, strict=True))
    ]
    head = ["# kind: component", "# components: [z]", "# noise: {z: 20 um}"]
    text = [*head, "pose,q1 [mm],q2 [mm],q3 [mm],z [mm]", *rows]
    Path("own.csv").write_text("\n".join(text))
    assert run("calibrate truth.yaml own.csv -o run --force") in (1, 2)
    assert "um as mm" in " ".join(capsys.readouterr().err.split())


def test_joined_files_of_two_days_are_named(capsys) -> None:
    robot, truth = make_truth("m503.gcode")
    write_points(POINTS, probe(robot, truth, POINTS))
    assert run("import m503.gcode --probes report.txt -o p.yaml --data a.csv") == 0
    text = Path("a.csv").read_text()
    for name, day, start in (("b", "2026-05-04", ""), ("c", "2026-05-31", "c")):
        head = f"# instrument: {{name: probe, measured: {day}}}\npose,"
        new = text.replace("pose,", head, 1)
        lines = [start + r if r[0].isdigit() else r for r in new.splitlines()]
        Path(f"{name}.csv").write_text("\n".join(lines))
    assert run("calibrate p.yaml b.csv c.csv -o run --allow-duplicates --verbose") in (0, 2)
    assert "are from 2026-05-04 and 2026-05-31" in " ".join(capsys.readouterr().out.split())
