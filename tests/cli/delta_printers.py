# SPDX-License-Identifier: Apache-2.0
"""Records of real delta printers (LOOPCAL_DATA/delta_printers) as the files that a user of loopcal
would have.

A record holds motor steps below the end stop at which the nozzle touched the bed, and the geometry
that the printer's firmware stored. Steps times the length of one step are the readings `drop` of
the family linear-delta, in mm; the height of the nozzle is a measurement of the component z.
"""

import json
from pathlib import Path
from typing import Any

ROBOT = """\
# {remark}
format: 1
family: linear-delta
name: printer
units: {{length: mm, angle: deg}}

radius: {radius}
angles: {angles}     # the third tower says where the x axis is; it is never changed
arms: {arms}
stops: {stops}
readings: drop       # carriage positions are counted down from the end stops
home: {{z: 50}}
fixed: {fixed}
"""
DATA = """\
# kind: component
# components: [z]
# noise: {{z: {sigma}}}
pose,q1 [mm],q2 [mm],q3 [mm],z [mm]
"""


def select_records_without_distances(data_folder: Path) -> dict[str, dict[str, Any]]:
    """Return the records without distances, by repository and file."""
    return {
        name: record
        for name, record in read_records(data_folder).items()
        if not record["distances"]
    }


def read_records(data_folder: Path) -> dict[str, dict[str, Any]]:
    """Return all records, by repository and file."""
    found = json.loads(
        (data_folder / "delta_printers" / "real_delta_calibrations.json").read_text("utf-8")
    )
    return {f"{r['source']['repo']} {r['source']['path']}": r for r in found}


def list_stored_geometry(record: dict[str, Any]) -> dict[str, float]:
    """Return the geometry that the firmware stored, by parameter name [mm, deg]."""
    found = record["geometry_stored_in_config"]
    named = {"radius": found["radius"]}
    for i in range(3):
        named |= {
            f"tower{i + 1}.angle": found["angles"][i],
            f"tower{i + 1}.stop": found["endstops"][i],
        }
    return named


def write_files(
    record: dict[str, Any], folder: Path, stop_offset: float = 0.0, sigma: str = "20 um"
) -> None:
    """Write robot.yaml and heights.csv.

    Parameters
    ----------
    record : of the JSON file.
    folder : where to write.
    stop_offset : added to every end stop [mm], to start the fit away from the stored geometry.
    sigma : standard deviation of the probe, with its unit.
    """
    found = record["geometry_stored_in_config"]
    robot = ROBOT.format(
        remark=f"{record['source']['repo']}, {record['source']['path']}",
        radius=found["radius"],
        angles=found["angles"],
        arms=found["arms"],
        stops=[stop + stop_offset for stop in found["endstops"]],
        fixed="[arm*.length]",
    )
    (folder / "robot.yaml").write_text(robot, "utf-8")
    rows = []
    for i, row in enumerate(record["heights"], start=1):
        drops = [
            steps * step for steps, step in zip(row["stable_steps"], found["stepdist"], strict=True)
        ]
        rows.append(",".join([f"point{i}", *(f"{drop:.10g}" for drop in drops), f"{row['z_mm']}"]))
    (folder / "heights.csv").write_text(DATA.format(sigma=sigma) + "\n".join(rows) + "\n", "utf-8")
