# SPDX-License-Identifier: Apache-2.0
"""Samples of a hanging printer: motor angles of n lines at poses of which some are known, for
auto-calibration.

A JSON file of lengths in mm and motor angles in degrees, counted from where all motors read zero.
With spool radius r0, gear g = motor teeth / spool teeth, m runs of line in the tackle, s lines on a
spool and a build-up k (r^2 grows by k for each mm that is wound), motor angle q pays out

    dL = (s / m) (r0 g q - k (g q)^2 / 4)

which is exact: dr/d(g q) = -k / 2. Spool radius and build-up become named parameters of the robot
file, the anchors and the lengths at zero its errors. Known poses are measurements of the kind
`position`; a pose nobody measured keeps its readings alone, and n - 3 equations. Source of the
keys: the program auto-calibration-simulation-for-hangprinter.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import FileError
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import Format, Imported, ImportOptions

if TYPE_CHECKING:
    from loopcal.measure import Measurements
    from loopcal.typing import FloatArray

MM, DEG = 1e-3, math.pi / 180.0
FREEDOMS = 3
KNOWN_ROUNDING = 1e-6
"""Singular value, relative to the largest, below which the known poses do not tell an anchor [1].
"""

NOT_READ = {
    "force_samp": "line forces are not read: lines of a robot file do not stretch, so stretch "
    "stays in the residuals",
    "springKPerUnitLength": "the stiffness of the lines is not read: what they stretch stays in "
    "the residuals",
    "mover_weight": "the weight of the platform is not read: forces play no part",
    "line_lengths_when_at_origin": "the lengths taped at the origin are not read: anchors start "
    "from the known poses",
}
"""Keys that have no place in a robot file, and what that means."""

IGNORED = ("_source", "abc_axis_min_force_limit", "abc_axis_max_force_limit")

ROBOT = """\
# Read from {origin}, samples of a hanging printer. Readings are motor angles, zero at the origin,
# paying out as they grow.
format: 1
family: limbs
name: {name}
source: {source}
units: {{length: mm, angle: deg}}

freedoms: [x, y, z]
controlled: [x, y, z]
# radius: line paid out per radian of the motor; sigma: what {sigma:g} mm of line are
actuators:
{drives}
# lengths at readings of zero; anchors start from the known poses, tolerances are of that start
limbs:
{limbs}
parameters:               # of the spools; buildup: growth of radius^2 for each length that is wound
{parameters}
home: {{z: 0}}
workspace: {{x: {side}, y: {side}, z: [0, {top:g}]}}     # taken; say where the printer really goes
"""
LIMB = (
    "  - {{name: {name}, tip: {tip}, ending: distance, length: {length}, actuated: {drive}, "
    "errors: [{{of: base, shift: [x, y, z], name: anchor, tolerance: {{sd: 200}}}}, "
    "{{of: rod, shift: [length], tolerance: {{sd: 200}}}}]}}"
)
PARAMETER = "  - {{name: {name}, length: {nominal}, tolerance: {{sd: {sd}}}, maps: [{maps}]}}"
ONTO = "{{limb: {drive}, element: transmission, axis: {axis}, coefficient: {coefficient}}}"


@dataclass(frozen=True, eq=False)
class Samples:
    """What a file holds, n lines and N poses of which the first K are known. Lengths [mm], angles
    [rad].

    Attributes
    ----------
    radius, mechanical_advantage, lines_per_spool : (n,). gear : turns of the spool for one of the
        motor.
    motors : (N, n). known : (K, 3). anchors : (n, 3) where the file states them, else None. notes :
        what was not read.
    """

    radius: FloatArray
    mechanical_advantage: FloatArray
    lines_per_spool: FloatArray
    gear: float
    motors: FloatArray
    known: FloatArray
    anchors: FloatArray | None = None
    notes: tuple[str, ...] = field(default=())

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
        """Of the lines, as their builders call them."""
        return tuple("ABCDEFGHIJKLMNOPQRSTUVWXYZ"[: len(self.radius)])


def read(path: Path, reading: ImportOptions) -> Imported:
    """Read robot and samples.

    Raises
    ------
    FileError
        No JSON, a key is missing, not of numbers or not of the right length, or the known poses do
        not tell an anchor and the file states none.
    """
    samples = parse(path)
    anchors = samples.anchors if samples.anchors is not None else anchors_from_known(samples, path)
    assumed = (
        f"{len(samples.motors)} poses of {len(samples.names)} motor angles, {len(samples.known)} "
        "of them known; a line is taken"
        f" to be known to {reading.sigma_line / MM:g} mm and a known pose to "
        f"{reading.sigma_position / MM:g} mm, which the file"
        " does not state"
    )
    text = robot_text(samples, anchors, path, reading)
    return Imported(text, _measurements(samples, reading), (assumed, *samples.notes))


def parse(path: Path) -> Samples:
    """Read and check the file; FileError as `read`."""
    try:
        found = json.loads(read_text(path, "file of samples"))
    except json.JSONDecodeError as error:
        raise FileError(
            f"this is no JSON ({error.msg}); correct it, or state another --format",
            path,
            error.lineno,
        ) from None
    if not isinstance(found, dict) or "motor_pos_samp" not in found:
        raise FileError(
            "there is no key 'motor_pos_samp', so these are no samples of a hanging printer", path
        )
    motors = _numbers(found, "motor_pos_samp", path, 2)
    lines = motors.shape[1]
    if not FREEDOMS <= lines <= 26:
        raise FileError(
            f"'motor_pos_samp' has {lines} motors in a row; a point in space needs 3 lines or more",
            path,
        )
    known = (
        np.zeros((0, FREEDOMS))
        if found.get("xyz_of_samp") == []
        else _numbers(found, "xyz_of_samp", path, 2, FREEDOMS)
    )
    if len(known) > len(motors):
        raise FileError(
            f"'xyz_of_samp' has {len(known)} poses and 'motor_pos_samp' only {len(motors)}; leave "
            "out the rest",
            path,
        )
    teeth = [_positive(found, key, path, 0) for key in ("motor_gear_teeth", "spool_gear_teeth")]
    radius, advantage, per_spool = (
        _positive(found, key, path, 1, lines)
        for key in ("spool_r_in_origin_first_guess", "mechanical_advantage", "lines_per_spool")
    )
    anchors = _numbers(found, "anchors", path, 2, FREEDOMS) if "anchors" in found else None
    if anchors is not None and len(anchors) != lines:
        raise FileError(
            f"'anchors' has {len(anchors)} rows for {lines} lines; give one for each", path
        )
    gear = float(teeth[0] / teeth[1])
    return Samples(
        radius, advantage, per_spool, gear, motors * DEG, known, anchors, tuple(_notes(found))
    )


def anchors_from_known(samples: Samples, path: Path) -> FloatArray:
    """Anchors (n, 3) [mm] by linear least squares on the known poses, spools without build-up.

    At a known x, |x - a| = |a| + dL gives x . a + dL |a| = (x . x - dL^2) / 2, linear in a and |a|.

    Raises
    ------
    FileError
        No pose is known, or the known poses have rank below 4: too few, or in a plane through the
        origin.
    """
    if not len(samples.known):
        raise FileError(
            "no pose is known; add poses to 'xyz_of_samp' (mm), at several heights, or where each "
            "line is anchored under the"
            " key 'anchors' (mm)",
            path,
        )
    x, dl = samples.known, samples.motors[: len(samples.known)] * samples.gain
    anchors = []
    for name, d in zip(samples.names, dl.T, strict=True):
        a, _, rank, s = np.linalg.lstsq(
            np.column_stack([x, d]), 0.5 * ((x * x).sum(axis=1) - d * d), rcond=KNOWN_ROUNDING
        )
        if rank < FREEDOMS + 1:
            raise FileError(
                f"the {len(x)} known poses do not tell where line {name} is anchored (rank {rank} "
                "of 4, singular values "
                f"{', '.join(f'{value:.3g}' for value in s)}); know poses at several heights, or "
                "add the key 'anchors' (mm)",
                path,
            )
        anchors.append(a[:FREEDOMS])
    return np.array(anchors)


def robot_text(samples: Samples, anchors: FloatArray, path: Path, reading: ImportOptions) -> str:
    """The robot file, one limb a line; spools whose radii are equal share one parameter."""
    sigma = reading.sigma_line / MM
    lengths = np.linalg.norm(anchors, axis=1)
    drives = [
        f"  {name.lower()}: {{reads: angle, radius: {_written(gain)}, sigma: "
        f"{_written(sigma / gain / DEG, 7)}}}"
        for name, gain in zip(samples.names, samples.gain, strict=True)
    ]
    limbs = [
        LIMB.format(
            name=name,
            tip=[float(_written(v)) for v in a],
            length=_written(length),
            drive=name.lower(),
        )
        for name, a, length in zip(samples.names, anchors, lengths, strict=True)
    ]
    return ROBOT.format(
        origin=path.name.replace("\n", " "),
        name=json.dumps(reading.name),
        source=json.dumps(f"{path.name}, samples of a hanging printer"),
        sigma=sigma,
        drives="\n".join(drives),
        limbs="\n".join(limbs),
        parameters="\n".join(_parameters(samples)),
        side=[-round(0.25 * lengths.min()), round(0.25 * lengths.min())],
        top=round(0.5 * max(anchors[:, 2].max(), lengths.min())),
    )


def _parameters(samples: Samples) -> Iterator[str]:
    """Spool radii, one where they are equal, and a build-up for each line."""
    slope = samples.gear * samples.share
    groups: dict[float, list[int]] = {}
    for i, radius in enumerate(samples.radius.tolist()):
        groups.setdefault(radius, []).append(i)
    for radius, members in groups.items():
        name = (
            "spool.radius"
            if len(groups) == 1
            else f"spool{'-'.join(samples.names[i] for i in members)}.radius"
        )
        maps = ", ".join(
            ONTO.format(drive=samples.names[i].lower(), axis="gain", coefficient=_written(slope[i]))
            for i in members
        )
        yield PARAMETER.format(name=name, nominal=_written(radius), sd=3, maps=maps)
    for i, name in enumerate(samples.names):
        # dL = .. - k (g q)^2 / 4 of the line unwound
        onto = ONTO.format(
            drive=name.lower(), axis="curve", coefficient=_written(-samples.gear * slope[i] / 4)
        )
        yield PARAMETER.format(name=f"{name}.buildup", nominal=0, sd=0.3, maps=onto)


def _measurements(samples: Samples, reading: ImportOptions) -> Measurements:
    """All readings, and the known poses as positions of the platform; cells of NaN where none is
    known, to be filled in.
    """
    from loopcal.measure import Measurements, Observations
    from loopcal.measure.kinds.position import Position

    kind = Position().with_tool(np.eye(4))
    known = (
        samples.known * MM
        if len(samples.known)
        else np.full((len(samples.motors), FREEDOMS), np.nan)
    )
    seen = Observations.from_sigma(kind, np.arange(len(known)), known, reading.sigma_position)
    labels = tuple(
        f"{'known' if i < len(samples.known) else 'sample'}{i + 1}"
        for i in range(len(samples.motors))
    )
    return Measurements(reading.name, samples.motors, (seen,), labels=labels)


def _notes(found: dict[str, Any]) -> Iterator[str]:
    """What is not read of a file."""
    read_keys = {
        "motor_pos_samp",
        "xyz_of_samp",
        "motor_gear_teeth",
        "spool_gear_teeth",
        "spool_r_in_origin_first_guess",
    }
    read_keys |= {"mechanical_advantage", "lines_per_spool", "anchors"}
    for key, sentence in NOT_READ.items():
        if key == "force_samp" and key in found:
            rows = len(found[key]) if isinstance(found[key], list) else 0
            yield f"{rows} rows of {sentence}; {len(found['motor_pos_samp'])} rows of motor angles go with them"
        elif key in found:
            yield sentence
    for key in sorted(found.keys() - read_keys - NOT_READ.keys() - set(IGNORED)):
        yield f"the key {key!r} is not known and not read"


def _positive(
    found: dict[str, Any], key: str, path: Path, ndim: int, width: int | None = None
) -> FloatArray:
    """Numbers above zero."""
    values = _numbers(found, key, path, ndim, width)
    if not (values > 0).all():
        raise FileError(f"{key!r} is {found[key]}; all of it must be above zero", path)
    return values


def _numbers(
    found: dict[str, Any], key: str, path: Path, ndim: int, width: int | None = None
) -> FloatArray:
    """An array of finite numbers of `ndim` axes, the last of `width`; FileError otherwise."""
    wanted = ("a number", "a list of numbers", "a list of rows of numbers")[ndim]
    wanted += "" if width is None else f", {width} in {'all' if ndim == 1 else 'each'}"
    if key not in found:
        raise FileError(f"the key {key!r} is missing; give {wanted}", path)
    try:
        values = np.array(found[key], dtype=float)
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if (
        values.ndim != ndim
        or values.size == 0
        or not np.isfinite(values).all()
        or (width and values.shape[-1] != width)
    ):
        raise FileError(f"{key!r} is not {wanted}; correct it", path)
    return values


def _written(value: float, digits: int = 12) -> str:
    """A number for a file."""
    return f"{float(value):.{digits}g}"


FORMAT = Format(
    "hangprinter",
    "samples of a hanging printer (JSON)",
    (),
    read,
    reads=("sigma_line", "sigma_position"),
)
