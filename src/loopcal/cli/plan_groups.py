# SPDX-License-Identifier: Apache-2.0
"""`loopcal plan --measure plane-line`: points on planes and lines that a coordinate measuring
machine holds.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from loopcal.cli import show
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.mechanism import Mechanism
    from loopcal.planning.constraints import Constraints

GROUPS, POINTS = 10, 8
COUNTED, HELD = (
    "which counts --groups and --points",
    "where a measuring machine holds x, y or z to --sigma-position",
)
CHOSEN, ALL = (
    "which moves points within the workspace and chooses by criterion D",
    "where every point is fitted",
)
OTHERS = {
    **dict.fromkeys(("poses", "accuracy", "curve"), COUNTED),
    **dict.fromkeys(("like", "kind", "components", "orientation", "sigma_angle"), HELD),
    **dict.fromkeys(("criterion", "candidates", "allowed"), CHOSEN),
    "hold_out": ALL,
    "measured": "which plans as if nothing had been measured",
    "frames": "whose surfaces are unknown in every group",
}
"""Options that mean nothing here, and why."""


def refuse_others(context: click.Context) -> None:
    """Refuse options that were given and mean nothing where planes and lines are planned.

    Raises
    ------
    DataError
        With the first of them, and why it means nothing.
    """
    for option in context.command.params:
        given = (
            context.get_parameter_source(option.name or "")
            is not click.core.ParameterSource.DEFAULT
        )
        if given and (why := OTHERS.get(option.name or "")) is not None:
            raise DataError(
                f"{option.opts[-1]} does not go with --measure plane-line, {why}; leave it out"
            )


def plan_groups(
    robot: Mechanism,
    output: Path,
    counts: tuple[int | None, int | None],
    sigma: float,
    constraints: Constraints,
    inputs: Mapping[str, Path],
    seed: int,
    force: bool,
    as_json: bool,
) -> None:
    """Plan groups, write the folder, and print."""
    from loopcal.io.runs.plan_folder import DATA, SHEET, write_plan_folder
    from loopcal.io.runs.run_folder import collect_provenance
    from loopcal.io.runs.surface_sheet import format_surface_data, format_surface_sheet
    from loopcal.planning.plane_line_planning import SurfaceOptions, plan_surfaces

    groups, points = (
        usual if given is None else given
        for given, usual in zip(counts, (GROUPS, POINTS), strict=True)
    )
    show.progress("planning ...")
    made = plan_surfaces(robot, SurfaceOptions(groups, points, sigma, constraints, seed))
    document = made.to_dict() | {"made_by": collect_provenance(sys.argv, inputs, {"plan": seed})}
    write_plan_folder(
        output,
        {SHEET: format_surface_sheet(made), DATA: format_surface_data(made)},
        document,
        {},
        force,
    )
    if as_json:
        show.json_document(made.to_dict())
        return
    show.say(str(made))
    show.say(
        f"\nwritten to {output}: plan.csv to measure by, measurements.csv to fill in, plan.json"
    )
    show.say(f"then: loopcal calibrate {inputs['robot']} {output / DATA} -o run")
