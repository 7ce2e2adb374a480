# SPDX-License-Identifier: Apache-2.0
"""`loopcal plan --measure plane-line`: points on planes and lines that a coordinate measuring machine holds."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.cli import show
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.calibrate.plan.constraints import Constraints
    from loopcal.mechanism import Mechanism

GROUPS, POINTS = 10, 8


def plan_groups(
    robot: Mechanism,
    output: Path,
    counts: tuple[int | None, int | None],
    sigma: float,
    constraints: Constraints,
    refused: Mapping[str, Any],
    inputs: Mapping[str, Path],
    seed: int,
    force: bool,
    as_json: bool,
) -> None:
    """Plan groups, write the folder, and print; `refused` are options that mean nothing here."""
    from loopcal.calibrate.plan.plan_surfaces import plan_surfaces
    from loopcal.io.plan_folder import DATA, SHEET, write_plan_folder
    from loopcal.io.run_folder import made_by
    from loopcal.io.surface_sheet import surface_data_text, surface_sheet_text

    for option, value in refused.items():
        if value:
            raise DataError(f"{option} does not go with --measure plane-line, which counts --groups and --points; leave it out")
    groups, points = (usual if given is None else given for given, usual in zip(counts, (GROUPS, POINTS), strict=True))
    show.progress("planning ...")
    made = plan_surfaces(robot, groups, points, sigma, constraints, seed)
    document = made.to_dict() | {"made_by": made_by(sys.argv, inputs, {"plan": seed})}
    write_plan_folder(output, {SHEET: surface_sheet_text(made), DATA: surface_data_text(made)}, document, {}, force)
    if as_json:
        show.json_document(made.to_dict())
        return
    show.say(str(made))
    show.say(f"\nwritten to {output}: plan.csv to measure by, measurements.csv to fill in, plan.json")
    show.say(f"then: loopcal calibrate {inputs['robot']} {output / DATA} -o run")
