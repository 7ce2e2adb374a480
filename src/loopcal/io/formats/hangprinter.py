# SPDX-License-Identifier: Apache-2.0
"""Samples of a hanging printer: motor angles of n lines at poses, of which some are known.

A JSON file of lengths in mm and motor angles in degrees, counted from where all motors read zero.
With spool radius r0, gear g = motor teeth / spool teeth, m runs of line in the tackle, s lines on a
spool and a build-up k (r^2 grows by k for each mm that is wound), motor angle q pays out

    dL = (s / m) (r0 g q - k (g q)^2 / 4)

which is exact: dr/d(g q) = -k / 2. Spool radius and build-up become named parameters of the robot
file, the anchors and the lengths at zero its errors. Known poses are measurements of the kind
`position`; an unknown pose contributes its readings alone, and n - 3 equations. A taped length at
zero is prior knowledge: a nominal value whose tolerance is that of the tape. Source of the keys:
the program auto-calibration-simulation-for-hangprinter.

RepRapFirmware states anchors in `M669 N4 A0:-1610:-132 B..` and spools in `M666 R75:75:75:75 ..`: R
radius, U runs of line, O lines on a spool, L motor teeth, H spool teeth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.geometry import ANCHOR_RANK, solve_line_anchor
from loopcal.io.core.text_file import read_json
from loopcal.io.core.yaml_file import format_yaml
from loopcal.io.formats.program_format import (
    MM,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    ValueFile,
    format_head,
    format_short,
    round_digits,
    round_length,
)
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import LARGEST

DEG = math.pi / 180.0
FREEDOMS, MOST_LINES = 3, 26
NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
ANCHORS_OF_FIRMWARE = "ABCDIJLO"  # letters of the anchors in M669 of RepRapFirmware

SAMPLES, POSITIONS, ANCHORS = "motor_pos_samp", "xyz_of_samp", "anchors"
TAPED = "line_lengths_when_at_origin"
TEETH = ("motor_gear_teeth", "spool_gear_teeth")
SPOOLS = ("spool_r_in_origin_first_guess", "mechanical_advantage", "lines_per_spool")
READ = {SAMPLES, POSITIONS, ANCHORS, TAPED, *TEETH, *SPOOLS}
FORCES = "force_samp"
IGNORED = (FORCES, "springKPerUnitLength", "mover_weight")  # keys that a robot file cannot express
# Keys without effect on the geometry.
SILENT = ("_source", "abc_axis_min_force_limit", "abc_axis_max_force_limit")
WIDE = 200.0  # tolerance of numbers that are first estimates [mm]: it leaves them to the data
# Ratio of a taped length to that of the known poses at which the unit is another one.
FAR_OFF = 10.0
REMARK = "Readings are motor angles, zero at the origin; growing readings pay out line."
DIGITS = 12  # digits of the geometry in the robot file
COMMENTS = {
    "parameters": "of the spools; buildup: growth of radius^2 for each length that is wound",
    "workspace": "assumed. Replace by the real workspace",
}


@dataclass(frozen=True, eq=False)
class Samples:
    """The content of a file: n lines and N poses, of which the first K are known; [mm], [rad].

    radius, mechanical_advantage, lines_per_spool : (n,). gear : turns of the spool for one of the
        motor.
    motors : (N, n). known : (K, 3). anchors : (n, 3) where the file states them, else None.
    taped : (n,) lengths at motor zero that were measured by hand, NaN where they were not.
    findings : keys that are not read.
    """

    radius: FloatArray
    mechanical_advantage: FloatArray
    lines_per_spool: FloatArray
    gear: float
    motors: FloatArray
    known: FloatArray
    anchors: FloatArray | None
    taped: FloatArray
    findings: tuple[Finding, ...]

    @property
    def is_taped(self) -> BoolArray:
        """Which lines were taped (n,)."""
        return np.isfinite(self.taped)

    @property
    def share(self) -> FloatArray:
        """Line moved for line unwound (n,)."""
        return self.lines_per_spool / self.mechanical_advantage

    @property
    def gain(self) -> FloatArray:
        """Line paid out per radian of the motor (n,) [mm], on a spool without build-up."""
        return self.radius * self.gear * self.share

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the lines."""
        return tuple(NAMES[: len(self.radius)])


def read_config(file: ValueFile, options: ImportOptions) -> Imported:
    """Read anchors and spools of M669 and M666; FileError where one is missing or incomplete."""

    def list_numbers(command: str, letter: str, count: int) -> tuple[float, ...]:
        numbers = file.numbers(command, letter, ":")
        if len(numbers) != count:
            sentence = f"{letter} of {command} has {len(numbers)} numbers, but must have {count}"
            raise file.error(f"{sentence}. Correct it", command, letter)
        return numbers

    lines = int(file.number("M669", "N", 4.0))
    if not FREEDOMS <= lines <= len(ANCHORS_OF_FIRMWARE):
        raise file.error(f"N is {lines}. Write a number of 3 to 8 lines", "M669", "N")
    anchors = np.array([list_numbers("M669", name, 3) for name in ANCHORS_OF_FIRMWARE[:lines]])
    found = [list_numbers("M666", x, lines) for x in "RUOLH" if file.has("M666", x)]
    if len(found) < 5 or not (np.array(found) > 0).all():
        raise file.error("M666 needs positive R, U, O, L and H of each line. Add them", "M666", "R")
    radius, advantage, per_spool, motor, spool = np.array(found)
    gear, nothing = float(motor[0] / spool[0]), np.full(lines, np.nan)
    spools = (radius * motor / spool / gear, advantage, per_spool, gear)
    samples = Samples(*spools, np.zeros((0, lines)), np.zeros((0, 3)), anchors, nothing, ())
    text = format_robot(samples, anchors, file.path, options)
    return Imported(text, None, (report_finding("files.no-samples"),))


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the anchors as M669 of RepRapFirmware; DataError for a robot without anchors."""
    values, ending = source.values(), ".anchor.x"
    lines = [name.removesuffix(ending) for name in values if name.endswith(ending)]
    if not FREEDOMS <= len(lines) <= len(ANCHORS_OF_FIRMWARE):
        sentence = f"{source.robot.name} has no anchors of lines, and the format hangprinter"
        raise DataError(f"{sentence} holds no other. Use json or csv")
    words = [f"M669 K6 N{len(lines)}"]
    for line, letter in zip(lines, ANCHORS_OF_FIRMWARE, strict=False):
        names = [f"{line}.anchor.{axis}" for axis in "xyz"]
        numbers = (source.round_number(values.get(n, 0.0) / MM, n, MM, 3) for n in names)
        words.append(letter + ":".join(format_short(number, 3) for number in numbers))
    others = tuple(name for name in values if ".anchor." not in name)
    finding = report_finding("files.not-expressed", format="M669", names=others)
    return Exported(" ".join(words) + "\n", (finding,) if others else ())


def read(path: Path, options: ImportOptions) -> Imported:
    """Read robot and samples.

    FileError
        Not JSON, a key is missing or has other values, or the known poses do not determine an
        anchor and the file states none.
    """
    samples = parse(path)
    anchors = samples.anchors if samples.anchors is not None else estimate_anchors(samples, path)
    finding = report_finding(
        "files.sample-noise-assumed",
        poses=len(samples.motors),
        motors=len(samples.names),
        known=len(samples.known),
        sigma_line=Quantity(options.choose_noise("line") / MM, "mm"),
        sigma_position=Quantity(options.choose_noise("position") / MM, "mm"),
        line_assumed=options.is_noise_assumed("line"),
        position_assumed=options.is_noise_assumed("position"),
    )
    text = format_robot(samples, anchors, path, options)
    findings = [finding]
    if samples.is_taped.any():
        prior = report_finding(
            "files.taped-prior",
            count=int(samples.is_taped.sum()),
            sigma=Quantity(options.choose_noise("tape") / MM, "mm"),
            is_assumed=options.is_noise_assumed("tape"),
        )
        findings.append(prior)
    # without known poses all positions are NaN, to be filled in
    n, k = len(samples.motors), len(samples.known)
    known = samples.known * MM if k else np.full((n, FREEDOMS), np.nan)
    rows = options.observe(Position(), np.arange(len(known)), known, "line", "position")
    labels = tuple(f"{'known' if i < k else 'sample'}{i + 1}" for i in range(n))
    measurements = Measurements(options.name, samples.motors, (rows,), labels=labels)
    return Imported(text, measurements, (*findings, *samples.findings))


def parse(path: Path) -> Samples:
    """Read and check the file; FileError as `read`."""
    content = read_json(path, "file of samples", "correct it, or choose another format")
    if not isinstance(content, dict) or SAMPLES not in content:
        raise FileError(f"samples of a hanging printer need the key {SAMPLES!r}", path)
    motors = _parse_numbers(content, SAMPLES, path, 2)
    lines = motors.shape[1]
    if not FREEDOMS <= lines <= MOST_LINES:
        sentence = f"{SAMPLES!r} has {lines} motors in a row. Allowed: 3 to {MOST_LINES}"
        raise FileError(sentence, path)
    known = np.zeros((0, FREEDOMS))
    if content.get(POSITIONS) != []:
        known = _parse_numbers(content, POSITIONS, path, 2, FREEDOMS)
    if len(known) > len(motors):
        sentence = f"{POSITIONS!r} has {len(known)} poses, but {SAMPLES!r} only {len(motors)}"
        raise FileError(f"{sentence}. Remove the others", path)
    motor_teeth, spool_teeth = (_parse_numbers(content, key, path, 0) for key in TEETH)
    radius, advantage, per_spool = (_parse_numbers(content, key, path, 1, lines) for key in SPOOLS)
    anchors = None
    if ANCHORS in content:
        anchors = _parse_numbers(content, ANCHORS, path, 2, FREEDOMS)
        if len(anchors) != lines:
            sentence = f"{ANCHORS!r} has {len(anchors)} rows, but there are {lines} lines"
            raise FileError(f"{sentence}. Write one row for each", path)
    stated = content.get(TAPED)  # null or 0 for lines that were not taped
    cells = [None] * lines if stated is None else stated if isinstance(stated, list) else []
    if len(cells) != lines or not all(v is None or (_is_number(v) and v >= 0.0) for v in cells):
        raise FileError.of("files.taped-lengths", path, key=TAPED, value=str(stated), lines=lines)
    taped = np.array([v or np.nan for v in cells], dtype=float)
    gear = float(motor_teeth / spool_teeth)
    spools, findings = (radius, advantage, per_spool, gear), tuple(_report_ignored(content))
    return Samples(*spools, motors * DEG, known, anchors, taped, findings)


def estimate_anchors(samples: Samples, path: Path) -> FloatArray:
    """Return first estimates of the anchors (n, 3) [mm] from the known poses.

    Known poses determine an anchor least along its line: a taped length replaces its distance.

    FileError : no pose is known, or the known poses do not determine an anchor.
    """
    act = (
        f"Add known poses at several heights to {POSITIONS!r} (mm), or add the key {ANCHORS!r} (mm)"
    )
    if not len(samples.known):
        raise FileError(f"the samples give no pose. {act}", path)
    extensions = samples.motors[: len(samples.known)] * samples.gain
    anchors = []
    for i, (name, extension) in enumerate(zip(samples.names, extensions.T, strict=True)):
        anchor, rank, s = solve_line_anchor(samples.known, extension)
        if rank < ANCHOR_RANK:
            sentence = f"the {len(samples.known)} known poses do not determine the anchor of line"
            values = ", ".join(f"{value:.3g}" for value in s)
            reason = f"rank {rank} of {ANCHOR_RANK}, singular values {values}"
            raise FileError(f"{sentence} {name} ({reason}). {act}", path)
        if samples.is_taped[i]:
            length = float(np.linalg.norm(anchor))
            if not 1.0 / FAR_OFF < samples.taped[i] / length < FAR_OFF:
                raise FileError.of(
                    "files.taped-length-far-off",
                    path,
                    line=name,
                    taped=Quantity(float(samples.taped[i]), "mm"),
                    estimate=Quantity(length, "mm"),
                )
            anchor *= samples.taped[i] / length
        anchors.append(anchor)
    return np.array(anchors)


def format_robot(samples: Samples, anchors: FloatArray, path: Path, options: ImportOptions) -> str:
    """Return the robot file; spools of equal radius share one parameter."""
    sigma = options.choose_noise("line") / MM
    is_taped, apart = samples.is_taped, np.linalg.norm(anchors, axis=1)
    lengths = np.where(is_taped, samples.taped, apart) if is_taped.any() else apart
    sd_length = np.where(is_taped, options.choose_noise("tape") / MM, WIDE)
    is_prior = samples.anchors is not None and options.sigma_anchor is not None
    sd_anchor = options.sigma_anchor / MM if is_prior and options.sigma_anchor else WIDE
    drives = {
        name.lower(): {
            "reads": "angle",
            "radius": round_digits(gain, DIGITS),
            "sigma": round_digits(sigma / gain / DEG),
        }
        for name, gain in zip(samples.names, samples.gain, strict=True)
    }
    limbs = [
        {
            "name": name,
            "tip": [round_digits(v, DIGITS) for v in anchor],
            "ending": "distance",
            "length": round_digits(length, DIGITS),
            "actuated": name.lower(),
            "errors": [
                _describe_error("base", ["x", "y", "z"], sd_anchor, name="anchor"),
                _describe_error("rod", ["length"], sd),
            ],
        }
        for name, anchor, length, sd in zip(samples.names, anchors, lengths, sd_length, strict=True)
    ]
    side = round_length(0.25 * lengths.min())
    content = {
        "freedoms": ["x", "y", "z"],
        "controlled": ["x", "y", "z"],
        "actuators": drives,
        "limbs": limbs,
        "parameters": list(_list_parameters(samples)),
        "home": {"z": 0},
        "workspace": {
            "x": [-side, side],
            "y": [-side, side],
            "z": [0, round_length(0.5 * max(anchors[:, 2].max(), lengths.min()))],
        },
    }
    taped = ", measured by hand within their spreads" if is_taped.any() else ""
    origin = "prior knowledge" if is_prior else "first estimates with their spreads"
    comments = {
        **COMMENTS,
        "actuators": "radius: line paid out per radian of the motor; "
        f"sigma: the motor angle of {sigma:g} mm of line",
        "limbs": f"lengths at readings of zero{taped}; anchors are {origin}",
    }
    what, units = "samples of a hanging printer", ("mm", "deg")
    head = format_head(path, what, "limbs", options.name, units, REMARK)
    return head + format_yaml(content, comments)


def _describe_error(of: str, shift: list[str], sd: float, **name: str) -> dict[str, Any]:
    """Return an entry of `errors:`."""
    return {"of": of, "shift": shift, **name, "tolerance": {"sd": round_digits(sd)}}


def _list_parameters(samples: Samples) -> Iterator[dict[str, Any]]:
    """Yield spool radii, one where they are equal, and the build-up of each line."""
    slope = samples.gear * samples.share
    groups: dict[float, list[int]] = {}
    for i, radius in enumerate(samples.radius.tolist()):
        groups.setdefault(radius, []).append(i)

    def describe_map(i: int, axis: str, coefficient: float) -> dict[str, Any]:
        drive = samples.names[i].lower()
        place = {"limb": drive, "element": "transmission", "axis": axis}
        return {**place, "coefficient": round_digits(coefficient, DIGITS)}

    for radius, members in groups.items():
        group = "" if len(groups) == 1 else "-".join(samples.names[i] for i in members)
        yield {
            "name": f"spool{group}.radius",
            "length": round_digits(radius, DIGITS),
            "tolerance": {"sd": 3},
            "maps": [describe_map(i, "gain", slope[i]) for i in members],
        }
    for i, line in enumerate(samples.names):
        yield {
            "name": f"{line}.buildup",
            "length": 0,
            "tolerance": {"sd": 0.3},
            "maps": [describe_map(i, "curve", -samples.gear * slope[i] / 4)],
        }


def _report_ignored(content: dict[str, Any]) -> Iterator[Finding]:
    """Yield the keys that are not read."""
    for key in (key for key in IGNORED if key in content):
        if key == FORCES:
            rows = len(content[key]) if isinstance(content[key], list) else 0
            motors = len(content[SAMPLES])
            yield report_finding("files.forces-ignored", rows=rows, motors=motors)
        else:
            yield report_finding("files.key-ignored", key=key)
    for key in sorted(content.keys() - READ - set(IGNORED) - set(SILENT)):
        yield report_finding("files.key-unknown", key=key)


def _parse_numbers(
    content: dict[str, Any], key: str, path: Path, ndim: int, width: int | None = None
) -> FloatArray:
    """Return an array of finite numbers of `ndim` axes, the last one of `width`."""
    wanted = ("a number", "a list of numbers", "a list of rows of numbers")[ndim]
    wanted += "" if width is None else f", {width} in {'all' if ndim == 1 else 'each'}"
    if key not in content:
        raise FileError(f"the key {key!r} is missing. Add {wanted}", path)
    rows = content[key]
    if ndim == 2 and isinstance(rows, list) and all(isinstance(row, list) for row in rows):
        lengths = [len(row) for row in rows]
        usual = max(lengths, key=lengths.count, default=0) if width is None else width
        for number, length in enumerate(lengths, 1):
            if length != usual:
                code = "files.row-incomplete"
                raise FileError.of(code, path, key=key, row=number, length=length, usual=usual)
    cells = np.array(rows, dtype=object)
    has_shape = cells.ndim == ndim and cells.size and width in (None, *cells.shape[-1:])
    if not has_shape or not all(map(_is_number, cells.flat)):
        raise FileError(f"{key!r} is not {wanted}. Correct it", path)
    values = cells.astype(float)
    if not (np.abs(values) <= LARGEST).all():
        raise FileError(f"{key!r} contains a number above {LARGEST:g}. Correct it", path)
    if key in (*TEETH, *SPOOLS) and not (values > 0).all():
        raise FileError(f"{key!r} is {content[key]}. Write positive numbers", path)
    return values


def _is_number(value: Any) -> bool:
    """Return whether a value of JSON is a number, which is finite."""
    return isinstance(value, int | float) and not isinstance(value, bool)


FORMAT = Format(
    "hangprinter",
    "samples of a hanging printer (JSON); anchors as M669",
    (),
    read,
    write,
    takes_file=False,
    read_options={
        "sigma_line": "",
        "sigma_position": "",
        "sigma_tape": "lines at the origin",
        "sigma_anchor": "",
    },
    mark=f'"{SAMPLES}"',
)
