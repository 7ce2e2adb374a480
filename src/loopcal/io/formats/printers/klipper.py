# SPDX-License-Identifier: Apache-2.0
"""Klipper's printer.cfg of a delta printer: geometry, probes of `DELTA_CALIBRATE`, corrections.

Tower k = a, b, c has `angle`, `arm_length` and `position_endstop` in [stepper_k]; `delta_radius` is
in [printer]. A stable position counts the motor steps of each tower below its end stop, so that
readings do not depend on the geometry: reading = steps * rotation_distance / (microsteps *
full_steps_per_rotation * gear_ratio), or older `step_distance`. [delta_calibrate] contains heights
(`height0`, `height0_pos`, also `manual_height0`) and distances (`distance0`, `distance0_pos1`,
`distance0_pos2`). Source: the documents "Configuration reference" and "Delta calibrate" of Klipper.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.findings import Finding, Quantity, report_finding
from loopcal.io.core.numbers import parse_finite
from loopcal.io.formats.printers import printer_cfg
from loopcal.io.formats.printers.delta_geometry import (
    NOMINAL_ANGLES,
    DeltaGeometry,
    Three,
    as_three,
    format_number,
    format_robot,
    get_geometry,
    is_same,
)
from loopcal.io.formats.printers.printer_cfg import PrinterConfig
from loopcal.io.formats.program_format import (
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    get_byte_order_mark,
    report_change,
    report_changes,
)

if TYPE_CHECKING:
    from loopcal.measure import Measurements

STEPPERS = ("stepper_a", "stepper_b", "stepper_c")
PROBED = "delta_calibrate"
FULL_STEPS = 200.0
MM = 1e-3


@dataclass(frozen=True)
class _Probes:
    """Stable positions [steps] by label, heights (label, value) and distances (label, label, value)
    in mm.
    """

    positions: dict[str, Three]
    heights: list[tuple[str, float]]
    distances: list[tuple[str, str, float]]


def read(path: Path, options: ImportOptions) -> Imported:
    """Read geometry and measurements.

    Raises
    ------
    FileError : an option is missing or not a number, or the printer is not a delta.
    """
    cfg = printer_cfg.read(path)
    if (kinematics := cfg.text("printer", "kinematics")) != "delta":
        sentence = f"kinematics is {kinematics!r}, but loopcal only reads Klipper's delta printers"
        raise cfg.error(f"{sentence} (kinematics: delta)", "printer", "kinematics")
    probes = _parse_probes(cfg)
    program, has_distances = "a printer.cfg of Klipper", bool(probes.distances)
    text = format_robot(parse_geometry(cfg), options.name, path, program, has_distances)
    if not probes.positions:
        return Imported(text, None, (report_finding("files.no-probed-heights"),))
    steps = [get_step_distance(cfg, section) for section in STEPPERS]
    finding = report_finding(
        "files.probe-noise-assumed",
        heights=len(probes.heights),
        distances=len(probes.distances),
        sigma_height=Quantity(options.sigma_height / MM, "mm"),
        sigma_distance=Quantity(options.sigma_distance / MM, "mm"),
    )
    return Imported(text, _build_measurements(probes, steps, options), (finding,))


def parse_geometry(cfg: PrinterConfig) -> DeltaGeometry:
    """Return the geometry with Klipper's defaults: arm and stop of tower a, angles 210, 330, 90."""
    angles = zip(STEPPERS, NOMINAL_ANGLES, strict=True)
    arm = cfg.number(STEPPERS[0], "arm_length")
    stop = cfg.number(STEPPERS[0], "position_endstop")
    return DeltaGeometry(
        cfg.number("printer", "delta_radius"),
        as_three([cfg.number(s, "angle", nominal) for s, nominal in angles]),
        as_three([cfg.number(s, "arm_length", arm) for s in STEPPERS]),
        as_three([cfg.number(s, "position_endstop", stop) for s in STEPPERS]),
    )


def get_step_distance(cfg: PrinterConfig, section: str) -> float:
    """Return the length of one motor step [mm]."""
    has_rotation = cfg.has(section, "rotation_distance")
    if not has_rotation and cfg.has(section, "step_distance"):
        return cfg.positive(section, "step_distance")
    rotation = cfg.positive(section, "rotation_distance")
    steps = cfg.positive(section, "microsteps")
    steps *= cfg.positive(section, "full_steps_per_rotation", FULL_STEPS)
    return rotation / (steps * _parse_gear_ratio(cfg, section))


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the corrected numbers in an existing printer.cfg, or a saved block to paste."""
    geometry = get_geometry(source, "klipper")
    if into is None:
        cfg = printer_cfg.parse((), Path("printer.cfg"))
        for section, option, value in _list_options(geometry):
            cfg = cfg.replace(section, option, format_number(value))
        text = "".join(cfg.lines).lstrip("\n")
        return Exported(text, (report_finding("files.saved-block"),))
    cfg = printer_cfg.read(into)
    changes: list[Finding] = []
    for section, option, value in _list_options(geometry):
        present = _get_present(cfg, section, option)
        if present is not None and is_same((present, value)):
            continue
        text = format_number(value)
        cfg = cfg.replace(section, option, text)
        line = cfg.options[section, option].line + 1
        before = None if present is None else format_number(present)
        changes.append(report_change(line, f"[{section}] {option}", before, text))
    return Exported(get_byte_order_mark(into) + "".join(cfg.lines), report_changes(changes))


def _list_options(geometry: DeltaGeometry) -> Iterator[tuple[str, str, float]]:
    """Yield section, option and value of the geometry."""
    yield "printer", "delta_radius", geometry.radius
    for k, section in enumerate(STEPPERS):
        yield section, "angle", geometry.angles[k]
        yield section, "arm_length", geometry.arms[k]
        yield section, "position_endstop", geometry.stops[k]


def _get_present(cfg: PrinterConfig, section: str, option: str) -> float | None:
    """Return the number that counts now, by Klipper's defaults; None where there is none."""
    if cfg.has(section, option):
        return cfg.number(section, option)
    if option == "angle" and section in STEPPERS:
        return NOMINAL_ANGLES[STEPPERS.index(section)]
    return cfg.number(STEPPERS[0], option) if cfg.has(STEPPERS[0], option) else None


def _parse_probes(cfg: PrinterConfig) -> _Probes:
    """Return the probes of [delta_calibrate]; like Klipper, up to the first missing number."""
    probes = _Probes({}, [], [])
    for name in ("height", "manual_height"):
        for i in count():
            if not cfg.has(PROBED, f"{name}{i}"):
                break
            probes.positions[f"{name}{i}"] = cfg.three(PROBED, f"{name}{i}_pos")
            probes.heights.append((f"{name}{i}", cfg.number(PROBED, f"{name}{i}")))
    for i in count():
        if not cfg.has(PROBED, f"distance{i}"):
            break
        ends = (f"distance{i}_pos1", f"distance{i}_pos2")
        for end in ends:
            probes.positions[end] = cfg.three(PROBED, end)
        probes.distances.append((*ends, cfg.number(PROBED, f"distance{i}")))
    return probes


def _build_measurements(
    probes: _Probes, steps: list[float], options: ImportOptions
) -> Measurements:
    """Return heights as the component z, distances as separations of two poses."""
    import numpy as np

    from loopcal.measure import Component, Measurements, Observations, Separation

    labels = tuple(probes.positions)
    readings = np.array([probes.positions[label] for label in labels]) * np.array(steps) * MM
    observations = []
    if probes.heights:
        kind = Component(components=("z",)).with_tool(np.eye(4))
        rows = [labels.index(label) for label, _ in probes.heights]
        measured = np.array([[value * MM] for _, value in probes.heights])
        observations.append(Observations.from_sigma(kind, rows, measured, options.sigma_height))
    if probes.distances:
        kind = Separation().with_tool(np.eye(4))
        pairs = [(labels.index(a), labels.index(b)) for a, b, _ in probes.distances]
        measured = np.array([[value * MM] for *_, value in probes.distances])
        observations.append(Observations.from_sigma(kind, pairs, measured, options.sigma_distance))
    return Measurements(options.name, readings, tuple(observations), labels=labels)


def _parse_gear_ratio(cfg: PrinterConfig, section: str) -> float:
    """Return the turns of the motor for one of the last gear: `57:11, 2:1` is 57 / 11 * 2."""
    if not cfg.has(section, "gear_ratio"):
        return 1.0
    text, ratio = cfg.text(section, "gear_ratio"), 1.0
    for pair in text.split(","):
        teeth = [parse_finite(part.strip()) or 0.0 for part in pair.split(":")]
        ratio *= teeth[0] / teeth[1] if len(teeth) == 2 and teeth[1] else 0.0
    if not ratio > 0:
        sentence = f"gear_ratio is {text!r}; write it as 80:16, or 57:11, 2:1 for several gears"
        raise cfg.error(sentence, section, "gear_ratio")
    return ratio


FORMAT = Format(
    "klipper",
    "printer.cfg of a Klipper delta printer",
    (".cfg",),
    read,
    write,
    reads=("sigma_height", "sigma_distance"),
    stores_fit=True,
)
