# SPDX-License-Identifier: Apache-2.0
"""Klipper's printer.cfg of a delta printer: geometry, what `DELTA_CALIBRATE` probed, and the
corrected geometry back.

Tower k = a, b, c has `angle`, `arm_length` and `position_endstop` in [stepper_k]; `delta_radius` is
in [printer]. A stable position counts the motor steps of each tower below its end stop, so that
readings do not depend on the geometry: reading = steps * rotation_distance / (microsteps *
full_steps_per_rotation * gear_ratio), or older `step_distance`. [delta_calibrate] holds heights
(`height0`, `height0_pos`, also `manual_height0`) and distances (`distance0`, `distance0_pos1`,
`distance0_pos2`). Source: the documents "Configuration reference" and "Delta calibrate" of Klipper.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.io.formats import printer_cfg
from loopcal.io.formats.delta_geometry import (
    NOMINAL_ANGLES,
    DeltaNumbers,
    Three,
    numbers_of,
    robot_text,
    same,
    three,
    written,
)
from loopcal.io.formats.printer_cfg import PrinterConfig
from loopcal.io.formats.program_format import (
    UNCHANGED,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    byte_order_mark,
)

if TYPE_CHECKING:
    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism

STEPPERS = ("stepper_a", "stepper_b", "stepper_c")
PROBED = "delta_calibrate"
FULL_STEPS = 200.0


@dataclass(frozen=True)
class _Probes:
    """Stable positions [steps] by label, heights [mm] (label, value) and distances [mm] (label,
    label, value).
    """

    positions: dict[str, Three]
    heights: list[tuple[str, float]]
    distances: list[tuple[str, str, float]]


def read(path: Path, reading: ImportOptions) -> Imported:
    """Read geometry and measurements; FileError for what is missing or no number, or a printer that
    is no delta.
    """
    cfg = printer_cfg.read(path)
    if (kind := cfg.text("printer", "kinematics")) != "delta":
        raise cfg.error(
            f"kinematics is {kind!r}; loopcal reads Klipper's delta printers (kinematics: delta)",
            "printer",
            "kinematics",
        )
    probes = _probes(cfg)
    text = robot_text(
        geometry(cfg), reading.name, path, "a printer.cfg of Klipper", bool(probes.distances)
    )
    if not probes.positions:
        return Imported(
            text,
            None,
            ("the file holds no probed heights; run DELTA_CALIBRATE and SAVE_CONFIG to have them",),
        )
    steps = [step_distance(cfg, section) for section in STEPPERS]
    notes = [
        f"{len(probes.heights)} heights and {len(probes.distances)} distances; Klipper states no "
        "noise: taken are "
        f"{reading.sigma_height * 1e3:g} mm"
        + (f" and {reading.sigma_distance * 1e3:g} mm" if probes.distances else "")
    ]
    return Imported(text, _measurements(probes, steps, reading), tuple(notes))


def geometry(cfg: PrinterConfig) -> DeltaNumbers:
    """The numbers that count, with Klipper's defaults: the arm and stop of tower a for all, angles
    210, 330, 90.
    """
    arm = cfg.number(STEPPERS[0], "arm_length")
    stop = cfg.number(STEPPERS[0], "position_endstop")
    angles = [
        cfg.number(s, "angle", nominal) for s, nominal in zip(STEPPERS, NOMINAL_ANGLES, strict=True)
    ]
    arms = [cfg.number(s, "arm_length", arm) for s in STEPPERS]
    stops = [cfg.number(s, "position_endstop", stop) for s in STEPPERS]
    return DeltaNumbers(
        cfg.number("printer", "delta_radius"), three(angles), three(arms), three(stops)
    )


def step_distance(cfg: PrinterConfig, section: str) -> float:
    """The length of one motor step [mm]."""
    if not cfg.has(section, "rotation_distance"):
        found = cfg.number(section, "step_distance") if cfg.has(section, "step_distance") else None
        if found is None:
            cfg.text(section, "rotation_distance")
        return _positive(cfg, section, "step_distance", found or 0.0)
    rotation = _positive(
        cfg, section, "rotation_distance", cfg.number(section, "rotation_distance")
    )
    micro = _positive(cfg, section, "microsteps", cfg.number(section, "microsteps"))
    full = _positive(
        cfg,
        section,
        "full_steps_per_rotation",
        cfg.number(section, "full_steps_per_rotation", FULL_STEPS),
    )
    return rotation / (micro * full * _gear_ratio(cfg, section))


def write(source: ExportSource, into: Path | None) -> Exported:
    """The corrected numbers in a printer.cfg whose other bytes stay; without one, a saved block to
    paste.
    """
    wanted = numbers_of(source, "klipper")
    if into is None:
        cfg = printer_cfg.parse((), Path("printer.cfg"))
        for section, option, value in _options(wanted):
            cfg = cfg.replaced(section, option, written(value))
        return Exported(
            "".join(cfg.lines).lstrip("\n"),
            ("a SAVE_CONFIG block; --into printer.cfg corrects a whole file",),
        )
    cfg = printer_cfg.read(into)
    notes = []
    for section, option, value in _options(wanted):
        present = _present(cfg, section, option)
        if present is not None and same(present, value):
            continue
        cfg = cfg.replaced(section, option, written(value))
        line = cfg.options[section, option].line + 1
        notes.append(
            f"line {line}: [{section}] {option} "
            f"{'added as' if present is None else f'{present:.6f} ->'} {written(value)}"
        )
    return Exported(byte_order_mark(into) + "".join(cfg.lines), tuple(notes or [UNCHANGED]))


def _options(wanted: DeltaNumbers) -> Iterator[tuple[str, str, float]]:
    yield "printer", "delta_radius", wanted.radius
    for k, section in enumerate(STEPPERS):
        yield section, "angle", wanted.angles[k]
        yield section, "arm_length", wanted.arms[k]
        yield section, "position_endstop", wanted.stops[k]


def _present(cfg: PrinterConfig, section: str, option: str) -> float | None:
    """The number that counts now, by Klipper's defaults where none is written; None where there is
    none at all.
    """
    if cfg.has(section, option):
        return cfg.number(section, option)
    if option == "angle" and section in STEPPERS:
        return NOMINAL_ANGLES[STEPPERS.index(section)]
    return cfg.number(STEPPERS[0], option) if cfg.has(STEPPERS[0], option) else None


def _probes(cfg: PrinterConfig) -> _Probes:
    """Everything in [delta_calibrate]; like Klipper, up to the first number that is missing."""
    found = _Probes({}, [], [])
    for name in ("height", "manual_height"):
        for i in count():
            if not cfg.has(PROBED, f"{name}{i}"):
                break
            found.positions[f"{name}{i}"] = cfg.three(PROBED, f"{name}{i}_pos")
            found.heights.append((f"{name}{i}", cfg.number(PROBED, f"{name}{i}")))
    for i in count():
        if not cfg.has(PROBED, f"distance{i}"):
            break
        ends = (f"distance{i}_pos1", f"distance{i}_pos2")
        for end in ends:
            found.positions[end] = cfg.three(PROBED, end)
        found.distances.append((*ends, cfg.number(PROBED, f"distance{i}")))
    return found


def _measurements(probes: _Probes, steps: list[float], reading: ImportOptions) -> Measurements:
    """Heights as the component z, distances as separations of two poses."""
    import numpy as np

    from loopcal.measure import Measurements, Observations
    from loopcal.measure.kinds.component import Component
    from loopcal.measure.kinds.separation import Separation

    labels = tuple(probes.positions)
    readings = np.array([probes.positions[label] for label in labels]) * np.array(steps) * 1e-3
    observations = []
    if probes.heights:
        kind = Component(components=("z",)).with_tool(np.eye(4))
        rows = [labels.index(label) for label, _ in probes.heights]
        measured = np.array([[value * 1e-3] for _, value in probes.heights])
        observations.append(Observations.from_sigma(kind, rows, measured, reading.sigma_height))
    if probes.distances:
        kind = Separation().with_tool(np.eye(4))
        pairs = [(labels.index(one), labels.index(two)) for one, two, _ in probes.distances]
        measured = np.array([[value * 1e-3] for *_, value in probes.distances])
        observations.append(Observations.from_sigma(kind, pairs, measured, reading.sigma_distance))
    return Measurements(reading.name, readings, tuple(observations), labels=labels)


def _gear_ratio(cfg: PrinterConfig, section: str) -> float:
    """Turns of the motor for one of the last gear: `57:11, 2:1` is 57 / 11 * 2."""
    if not cfg.has(section, "gear_ratio"):
        return 1.0
    text, ratio = cfg.text(section, "gear_ratio"), 1.0
    for pair in text.split(","):
        parts = pair.split(":")
        try:
            driven, driving = (float(part) for part in parts)
            ratio *= driven / driving
        except (ValueError, ZeroDivisionError):
            ratio = float("nan")
    if not 0 < ratio < float("inf"):
        raise cfg.error(
            f"gear_ratio is {text!r}; write it as 80:16, or 57:11, 2:1 for several gears",
            section,
            "gear_ratio",
        )
    return ratio


def _positive(cfg: PrinterConfig, section: str, option: str, value: float) -> float:
    if not value > 0:
        raise cfg.error(
            f"{option!r} of [{section}] is {value:g}; it must be greater than zero", section, option
        )
    return value


def judged(robot: Mechanism, measured: Measurements) -> tuple[str, ...]:
    """Whether the stored geometry is the optimum of Klipper's own cost; nothing where the probes do
    not determine one.
    """
    from loopcal.diagnose import compare_stored_geometry

    found = compare_stored_geometry(robot, measured)
    return () if found is None else (str(found),)


FORMAT = Format(
    "klipper",
    "printer.cfg of a Klipper delta printer",
    (".cfg",),
    read,
    write,
    reads=("sigma_height", "sigma_distance"),
    judged=judged,
)
