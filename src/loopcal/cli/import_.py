# SPDX-License-Identifier: Apache-2.0
"""`loopcal import`: a robot file, and measurements, from a file of another program."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, Quantity, json_option
from loopcal.errors import DataError
from loopcal.units import Dimension, list_symbols

if TYPE_CHECKING:
    from loopcal.estimate import Identification
    from loopcal.io.formats.program_format import Format, ImportOptions
    from loopcal.mechanism import Mechanism

FORMATS = ("klipper", "marlin", "reprap", "linuxcnc", "urdf", "hangprinter")
LENGTH = Quantity(Dimension.LENGTH)
SHOWN = 20
"""Lines that do not fit a profile that are shown."""

ASKED = {
    "sigma_height": "--sigma-height",
    "sigma_distance": "--sigma-distance",
    "sigma_line": "--sigma-line",
    "sigma_position": "--sigma-position",
    "length_unit": "--unit",
    "home_height": "--home-z",
    "closures": "--closures",
    "platform": "--platform",
}


@click.command("import", short_help="Read a controller's file as a robot file.")
@click.argument("file", metavar="FILE", type=FILE)
@click.option(
    "--format",
    "format_name",
    type=click.Choice(FORMATS),
    help="What FILE is; by the ending of its name.",
)
@click.option(
    "--profile",
    type=FILE,
    help="In place of --format: how FILE, an instrument's export, is to be read.",
)
@click.option(
    "-o",
    "--output",
    required=True,
    type=FILE,
    help="The robot file to write, called after the robot; with --profile the measurement file.",
)
@click.option("--data", type=FILE, help="Also write the measurements that FILE holds.")
@click.option(
    "--corrected",
    type=FILE,
    help="Also calibrate with them, and write FILE with the corrected numbers.",
)
@click.option(
    "--sigma-height",
    type=LENGTH,
    metavar="QUANTITY",
    help="Noise of the probe (klipper); 0.02mm if left out.",
)
@click.option(
    "--sigma-distance",
    type=LENGTH,
    metavar="QUANTITY",
    help="Noise of distances (klipper); 0.1mm if left out.",
)
@click.option(
    "--sigma-line",
    type=LENGTH,
    metavar="QUANTITY",
    help="Noise of lines (hangprinter); 1mm if left out.",
)
@click.option("--sigma-position", type=LENGTH, metavar="QUANTITY",
              help="Noise of known positions (hangprinter); 1mm if left out.")  # fmt: skip
@click.option(
    "--unit",
    "length_unit",
    type=click.Choice(list_symbols(Dimension.LENGTH)),
    help="Of lengths (linuxcnc).",
)
@click.option(
    "--home-z",
    "home_height",
    type=LENGTH,
    metavar="QUANTITY",
    help="Height of the home pose (linuxcnc).",
)
@click.option(
    "--closures",
    type=FILE,
    help="Which loops a URDF closes (urdf); FILE with the ending .yaml if left out.",
)
@click.option(
    "--platform",
    metavar="LINK",
    help="Which link is the platform (urdf); the one on a fixed joint if left out.",
)
@click.option("--force", is_flag=True, help="Replace files that are there.")
@json_option
def import_(
    file: Path, format_name: str | None, profile: Path | None, output: Path, data: Path | None, corrected: Path | None,
    force: bool, as_json: bool,
    **asked: Any,
) -> int:  # fmt: skip
    """Read FILE, which another program wrote, as a robot file and, where it holds any,
    measurements.

    With --corrected the exit code is 2 where the calibration did not converge.

    With --profile FILE is text that an instrument exported, and becomes a measurement file; see
    docs/exports.md.

    \b
    Examples:
      loopcal import printer.cfg -o printer.yaml --data heights.csv
      loopcal import printer.cfg -o printer.yaml --data heights.csv --corrected corrected.cfg
      loopcal import config-override.g --format reprap -o printer.yaml
      loopcal import export.txt --profile tracker.yaml -o measurements.csv
      loopcal import hexapod.hal --unit mm --home-z 200mm -o hexapod.yaml
      loopcal import samples.json --format hangprinter -o robot.yaml --data samples.csv --sigma-line
      0.7mm loopcal import five-bar.urdf --closures five-bar-loops.yaml -o five-bar.yaml
    """  # noqa: D301
    from loopcal.io.core.outputs import refuse_outputs, restore_on_failure
    from loopcal.io.formats.import_export import choose_format, save_imported

    if profile is not None:
        return _export(file, profile, output, force, as_json)
    source = choose_format(file, format_name)
    if source.read is None:
        raise DataError(
            f"loopcal writes the format {source.name}, but does not read it; known are "
            f"{', '.join(FORMATS)}"
        )
    if corrected is not None and data is None:
        raise DataError(
            "--corrected calibrates with the measurements in the file; say where to write them, as "
            "--data data.csv"
        )
    beside = file.with_suffix(".yaml") if source.name == "urdf" else None
    refuse_outputs((output, data), (file, asked["closures"] or beside), force)
    refuse_outputs((output, data, corrected), (), force)  # FILE may be corrected in place
    found = source.read(file, _reading(source, output.stem, asked))
    with restore_on_failure((output, data)):
        robot = save_imported(file, found, output, data)
        if source.judged is not None and found.measurements is not None:
            found = replace(found, notes=(*found.notes, *source.judged(robot, found.measurements)))
        fit = (
            None
            if corrected is None or data is None
            else _corrected(source, robot, file, data, corrected)
        )
    document: dict[str, Any] = {
        "robot": output,
        "data": data,
        "corrected": corrected,
        "notes": found.notes,
    }
    if as_json:
        show.json_document(
            document | {"fit": None if fit is None else fit[0].to_dict(), "changes": fit and fit[1]}
        )
    else:
        _print(robot, document, fit)
    return show.gates(
        [] if fit is None or fit[0].converged else [f"not converged: {fit[0].status.sentence}"]
    )


def _export(file: Path, profile: Path, output: Path, force: bool, as_json: bool) -> int:
    """Write the measurements of an export; say how many lines were read, passed over, and which do
    not fit.
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.exports import convert_export, read_profile

    given = click.get_current_context().get_parameter_source
    for parameter in click.get_current_context().command.params:
        own = parameter.name in {"file", "profile", "output", "force", "as_json"}
        if (
            not own
            and parameter.name
            and given(parameter.name) is click.core.ParameterSource.COMMANDLINE
        ):
            raise DataError(
                f"{parameter.opts[0]} does not go with --profile, which says how the file is read; "
                "leave it out"
            )
    refuse_outputs((output,), (file, profile), force)
    found = convert_export(file, read_profile(profile))
    write_text(output, found.text)
    if as_json:
        misfits = [{"line": line, "reason": reason} for line, reason in found.misfits]
        document = {
            "measurements": output,
            "rows": found.rows,
            "passed": found.passed,
            "misfits": misfits,
        }
        show.json_document(document | {"notes": found.notes})
        return 0
    show.say(f"{output}: {found.rows} rows; {found.passed} lines passed over as the profile says")
    for note in found.notes:
        show.say(f"note: {note}")
    for line, reason in found.misfits[:SHOWN]:
        show.say(f"note: {file}:{line} does not fit: {reason}")
    if len(found.misfits) > SHOWN:
        show.say(f"note: {len(found.misfits) - SHOWN} more lines do not fit; {output} lists them")
    return 0


def _reading(source: Format, name: str, asked: dict[str, Any]) -> ImportOptions:
    """What the options say; one that does not belong to the format is refused."""
    from loopcal.io.formats.program_format import ImportOptions

    given = {key: value for key, value in asked.items() if value is not None}
    for key in given:
        if key not in source.reads:
            raise DataError(
                f"{ASKED[key]} does not belong to the format {source.name}; leave it out"
            )
    return ImportOptions(name, **given)


def _corrected(
    source: Format, robot: Mechanism, file: Path, data: Path, output: Path
) -> tuple[Identification, tuple[str, ...]]:
    """Calibrate with what was read, and write the corrected file."""
    from loopcal.estimate import identify
    from loopcal.io import load_measurements
    from loopcal.io.core.text_file import write_text
    from loopcal.io.formats.import_export import export_robot
    from loopcal.io.formats.program_format import ExportSource

    fit = identify(robot, load_measurements(data, robot))
    written = export_robot(ExportSource(fit.robot), source, file)
    write_text(output, written.text)
    return fit, written.notes


def _print(
    robot: Mechanism, document: dict[str, Any], fit: tuple[Identification, tuple[str, ...]] | None
) -> None:
    """Print what was read, what was found, and which lines were changed."""
    free = int(robot.parameters.free.sum())
    show.say(
        f"{document['robot']}: {len(robot.actuators)} actuators, {len(robot.parameters)} "
        f"parameters, {free} free"
    )
    if document["data"] is not None:
        show.say(f"{document['data']}: the measurements of the file")
    for note in document["notes"]:
        show.say(f"note: {note}")
    if fit is None:
        data = document["data"] or "DATA"
        show.say(f"next: loopcal calibrate {document['robot']} {data} -o run")
        return
    found, changes = fit
    show.parameters(f"{robot.name}: {len(found.names)} parameters", found.to_dict()["parameters"])
    show.say(
        f"\n{found.status.sentence}; rank {found.rank} of {len(found.names)}; chi-square "
        f"{found.chi_square:.5g}"
    )
    for note in (*found.notes, *changes):
        show.say(f"note: {note}" if note in found.notes else note)
    show.say(f"written to {document['corrected']}; nothing else in it was changed")
