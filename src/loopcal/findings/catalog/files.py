# SPDX-License-Identifier: Apache-2.0
"""Findings about files: outputs, data that were fitted before, and files of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, Quantity, fill_template

IGNORED_KEYS = {
    "springKPerUnitLength": "the stiffness of the lines is not read, so stretch stays in the "
    "residuals",
    "mover_weight": "the weight of the platform is not read, because the model contains no forces",
    "line_lengths_when_at_origin": "the tape-measured lengths at the origin are not read; anchors "
    "start from the known poses",
}
"""Keys of samples of a hanging printer that a robot file cannot express."""


def _word_change(data: Mapping[str, Any]) -> str:
    added = data["before"] is None
    template = "line {line}: {name} " + ("added as {after}" if added else "{before} -> {after}")
    return fill_template(template, **data)


def _word_probe_noise(data: Mapping[str, Any]) -> str:
    distances = data["distances"]
    noise = "{sigma_height}" + (" and {sigma_distance}" if distances else "")
    template = (
        "{heights:count height} and {distances:count distance}; Klipper states no noise, so "
        + noise
        + (" are" if distances else " is")
        + " assumed"
    )
    return fill_template(template, **data)


def _word_ignored_key(data: Mapping[str, Any]) -> str:
    return IGNORED_KEYS[data["key"]]


def _word_joint(data: Mapping[str, Any]) -> str:
    turn = ", turned by {turn}" if data["turn"].value else ""
    return fill_template("line {line}: joint {joint} moved by {distance}" + turn, **data)


def _word_platform(data: Mapping[str, Any]) -> str:
    what = "several frames ({frames:list}) are on moving bodies"
    what = what if data["frames"] else "no moving body carries a frame"
    return fill_template(
        what + ", so the platform is not clear; name its link, one of {links:list}", **data
    )


ENTRIES: tuple[Entry, ...] = (
    Entry(
        "files.output-exists",
        Severity.REFUSAL,
        "this file exists; choose another name or allow replacing it",
        "An output file exists and replacing it was not allowed.",
        "Choose another name or allow replacing the file.",
    ),
    Entry(
        "files.folder-in-use",
        Severity.REFUSAL,
        "this folder is not empty; choose another name or allow replacing the {content} in it",
        "The folder of a run or plan is not empty and replacing it was not allowed.",
        "Choose another folder or allow replacing the old result.",
    ),
    Entry(
        "files.folder-of-others",
        Severity.REFUSAL,
        "this folder contains something other than a {content}, which is never replaced; choose "
        "another name",
        "The folder of a run or plan contains other files.",
        "Choose another folder.",
    ),
    Entry(
        "files.noise-missing",
        Severity.REFUSAL,
        "no noise is stated for {column!r}; add '{example}' to the settings, or a column "
        "{sigma!r}. If it is unknown, state a guess there and calibrate with the noise "
        "estimated from the residuals",
        "A measurement file states no standard deviation of a measured value.",
        "State the standard deviation in the settings or in a column.",
    ),
    Entry(
        "files.groups-in-plan",
        Severity.REFUSAL,
        "rows of the kind {kind!r} have setup parameters for each group ({parameters:list}), and "
        "no pose is measured by all groups; describe the instrument in another way",
        "A plan takes its instrument from a file whose groups have parameters of their own.",
        "Describe the instrument by its kind, noise and frames.",
    ),
    Entry(
        "files.surfaces-in-plan",
        Severity.REFUSAL,
        "rows of the kind {kind!r} have setup parameters for each group ({parameters:list}), and "
        "no pose is measured by all groups; plan planes and lines as surfaces",
        "A plan of poses takes its instrument from a file of planes or lines.",
        "Plan surfaces in place of poses.",
    ),
    Entry(
        "files.prior-data-reused",
        Severity.REFUSAL,
        "{file}: the earlier run was fitted to these measurements, which would count twice; use "
        "new measurements",
        "Data for a recalibration are the data of the run that serves as the prior.",
        "Measure again, or calibrate without the prior.",
    ),
    Entry(
        "files.other-times",
        Severity.INFO,
        "{count:count line} of further targets state another time than the first line of their "
        "pose; the time of the first line is kept",
        "An instrument's export has a line for each target, with different times.",
    ),
    Entry(
        "files.format-unknown",
        Severity.REFUSAL,
        "the format of this file is not known by its ending; name the format, one of "
        "{formats:list}",
        "A file of another program has an ending that no format uses.",
        "Name the format.",
    ),
    Entry(
        "files.format-takes-no-file",
        Severity.REFUSAL,
        "the format {format} is written as a new file and corrects no existing one",
        "An export names a file to correct, but the format has none.",
        "Export without a file to correct.",
    ),
    Entry(
        "files.no-measurements",
        Severity.REFUSAL,
        "{file} contains no measurements; import the robot alone, or measure first",
        "Measurements are to be imported from a file without any.",
        "Import the robot alone, or measure first.",
    ),
    Entry(
        "files.unchanged",
        Severity.INFO,
        "all numbers already have these values; nothing was changed",
        "The corrected numbers equal those of the file.",
    ),
    Entry(
        "files.value-changed",
        Severity.INFO,
        _word_change,
        "A value of a controller's file was corrected or added.",
        example={"line": 12, "name": "radius", "before": "125.0", "after": "124.871"},
    ),
    Entry(
        "files.not-expressed",
        Severity.WARNING,
        "{format} cannot express {names:list}; use json or csv for them",
        "An export leaves out changed parameters.",
        "Export them as JSON or CSV, and correct the machine by other means.",
    ),
    Entry(
        "files.intervals-need-run",
        Severity.INFO,
        "intervals are stored in runs; export the run folder to obtain them",
        "Parameters of a robot file are exported.",
        "Export the run folder.",
    ),
    Entry(
        "files.interval-missing",
        Severity.INFO,
        "{name} has no interval ({reason})",
        "An exported parameter has no finite interval.",
    ),
    Entry(
        "files.no-probed-heights",
        Severity.SUGGESTION,
        "the file contains no probed heights; run DELTA_CALIBRATE and SAVE_CONFIG to store them",
        "A printer.cfg of Klipper without probes is imported.",
        "Run DELTA_CALIBRATE and SAVE_CONFIG on the printer.",
    ),
    Entry(
        "files.probe-noise-assumed",
        Severity.INFO,
        _word_probe_noise,
        "Heights and distances of a printer.cfg are imported.",
        "State the noise of the probe and of the distances.",
        example={
            "heights": 37,
            "distances": 0,
            "sigma_height": Quantity(0.02, "mm"),
            "sigma_distance": Quantity(0.1, "mm"),
        },
    ),
    Entry(
        "files.saved-block",
        Severity.INFO,
        "this is a SAVE_CONFIG block to paste; name a printer.cfg to correct a whole file",
        "A geometry is exported for Klipper without a file to correct.",
    ),
    Entry(
        "files.probe-offset",
        Severity.INFO,
        "M851 Z{offset:g} is the probe offset; the height at home is H minus this offset",
        "Marlin's file has a probe offset.",
    ),
    Entry(
        "files.marlin-rod-trims",
        Severity.WARNING,
        "rod trims (M665 A, B, C) need Marlin 2.0.6 or later; older versions have one rod length "
        "and interpret B as a radius",
        "Arms of different length are exported for Marlin.",
        "Use Marlin 2.0.6 or later.",
    ),
    Entry(
        "files.reprap-rod-lengths",
        Severity.WARNING,
        "three rod lengths need RepRapFirmware 2.03 or later; older versions use the first for all",
        "Arms of different length are exported for RepRapFirmware.",
        "Use RepRapFirmware 2.03 or later.",
    ),
    Entry(
        "files.unit-missing",
        Severity.REFUSAL,
        "a HAL file states no unit of length; state the machine's unit, mm or in",
        "A HAL file is imported without a unit of length.",
        "State the unit of the machine.",
    ),
    Entry(
        "files.home-assumed",
        Severity.WARNING,
        "home is assumed {height} above the base, the radius of its joints; state the height of "
        "the home pose",
        "A HAL file is imported without the height of the home pose.",
        "State the height of the home pose, or correct it in the robot file.",
    ),
    Entry(
        "files.machine-unit",
        Severity.INFO,
        "numbers are in {unit}; the machine's unit of length must be the same",
        "A geometry is exported for LinuxCNC without a file to correct.",
    ),
    Entry(
        "files.strut-length",
        Severity.WARNING,
        "genhexkins cannot express that strut {strut} is {length} long at reading zero; add this "
        "to HOME_OFFSET of [JOINT_{strut}] in the INI file",
        "A calibration changed the zero of a strut, which LinuxCNC keeps in the INI file.",
        "Add the length to HOME_OFFSET of the joint.",
    ),
    Entry(
        "files.sample-noise-assumed",
        Severity.INFO,
        "{poses} poses of {motors} motor angles, {known} of them known; the file states no noise, "
        "so {sigma_line} is assumed for lines and {sigma_position} for known poses",
        "Samples of a hanging printer are imported.",
        "State the noise of lines and of known poses.",
    ),
    Entry(
        "files.forces-ignored",
        Severity.INFO,
        "{rows} rows of line forces are not read (with {motors} rows of motor angles); lines of a "
        "robot file do not stretch, so stretch stays in the residuals",
        "Samples of a hanging printer contain line forces.",
    ),
    Entry(
        "files.key-ignored",
        Severity.INFO,
        _word_ignored_key,
        "Samples of a hanging printer contain a key that a robot file cannot express.",
        example={"key": next(iter(IGNORED_KEYS))},
    ),
    Entry(
        "files.key-unknown",
        Severity.WARNING,
        "the key {key!r} is unknown and not read",
        "A file of samples contains an unknown key.",
        "Check the name of the key.",
    ),
    Entry(
        "files.closures-missing",
        Severity.REFUSAL,
        "a URDF is a tree without loops; name the file of its loop closures",
        "A URDF is imported without a file of loop closures.",
        "Write the closures into a YAML file and name it (docs/formats.md).",
    ),
    Entry(
        "files.platform-unknown",
        Severity.REFUSAL,
        "{platform!r} is not a moving link of this URDF; name one of {links:list}",
        "The named platform of a URDF is not a moving link.",
        "Name a moving link.",
    ),
    Entry(
        "files.platform-unclear",
        Severity.REFUSAL,
        _word_platform,
        "A URDF has no frame, or several, on moving bodies.",
        "Name the link that is the platform.",
        example={"frames": ("tool", "camera"), "links": ("plate", "rod1")},
    ),
    Entry(
        "files.limb-branches",
        Severity.REFUSAL,
        "joints {joints:list} meet in {body!r}, so a limb branches from a limb, which loopcal "
        "cannot express; choose a platform other than {platform!r}, or remove the branch",
        "The limbs of an imported mechanism branch.",
        "Choose another platform, or remove the branch.",
    ),
    Entry(
        "files.no-limbs",
        Severity.REFUSAL,
        "no limbs join the base and the platform {platform!r}; choose another platform",
        "An imported mechanism has no limbs between base and platform.",
        "Choose another platform.",
    ),
    Entry(
        "files.urdf-needed",
        Severity.REFUSAL,
        "a URDF contains more than a robot file; name the URDF to correct",
        "A robot is exported as URDF without a file to correct.",
        "Name the URDF that the robot was read from.",
    ),
    Entry(
        "files.joint-moved",
        Severity.INFO,
        _word_joint,
        "The origin of a joint of a URDF was corrected.",
        example={
            "line": 40,
            "joint": "a1",
            "distance": Quantity(0.31, "mm"),
            "turn": Quantity(0.002, "rad"),
        },
    ),
    Entry(
        "files.urdf-structure",
        Severity.INFO,
        "{bodies} rigid bodies with the base (of {links} links), {joints} joints ({loops} close "
        "loops), {motors} motors, mobility {mobility}",
        "A URDF is imported.",
    ),
    Entry(
        "files.urdf-home",
        Severity.INFO,
        "closure residual at home {residual}; platform frame {frame}, which moves in "
        "{freedoms:list}",
        "A URDF is imported.",
    ),
    Entry(
        "files.joints-replaced",
        Severity.WARNING,
        "joints {joints:list} branch from the limbs and only keep the platform from turning; the "
        "freedoms of the platform express this, and the origins of these joints are not identified",
        "A URDF contains parallelograms that keep the platform from turning.",
    ),
    Entry(
        "files.motors-differ",
        Severity.WARNING,
        "the mobility is {mobility}, but there are {motors:count motor}",
        "The mobility of an imported mechanism differs from its number of motors.",
        "Check the closures and the motors.",
    ),
)
