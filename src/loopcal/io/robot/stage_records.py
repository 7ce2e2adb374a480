# SPDX-License-Identifier: Apache-2.0
"""The stages of a robot file: each one is a serial joint, or a robot of another family.

A stage of another family has the keys of that family beside its own ones.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from loopcal.errors import suggest_names
from loopcal.io.core.records import Units, get_field_types, read_record
from loopcal.io.core.yaml_file import YamlFile, refuse_unknown_keys
from loopcal.mechanism import FAMILIES, RobotRecord
from loopcal.mechanism.families.stages import PlacedStages, StageRecord, Stages

KEY = "stages"
OWN_KEYS = ("on", "mount", "joint", "family")
"""Keys of a stage that are not those of its family; both have a name."""


def place_stages(file: YamlFile, chain: RobotRecord, units: Units) -> PlacedStages:
    """Return a chain with the records of its stages.

    Raises
    ------
    FileError : a stage is neither a joint nor a robot, or a key of it does not fit; at its line.
    """
    assert isinstance(chain, Stages)
    robots = tuple(_read_stage(file, i, stage, units) for i, stage in enumerate(chain.stages))
    own = {field.name: getattr(chain, field.name) for field in fields(chain)}
    return PlacedStages(**own, robots=robots)


def _read_stage(file: YamlFile, i: int, stage: StageRecord, units: Units) -> RobotRecord | None:
    """Return the record of a stage of another family, None for a serial joint."""
    content: dict[str, Any] = file.content[KEY][i]
    if (stage.joint is None) == (stage.family is None):
        both = stage.joint is not None
        raise file.error(
            f"stage {stage.name!r} states {'both' if both else 'neither'} 'joint' "
            f"{'and' if both else 'nor'} 'family'; write 'joint:' for a serial joint, or 'family:' "
            "with the keys of that family",
            (KEY, i),
        )
    if stage.family is None:
        refuse_unknown_keys(file, list(content), list(get_field_types(StageRecord)), (KEY, i))
        return None
    families = {name: record for name, record in FAMILIES.items() if record is not Stages}
    if stage.family not in families:
        hint = suggest_names(stage.family, list(families))
        raise file.error(
            f"{stage.family!r} is not a family of a stage{hint}; allowed: "
            f"{', '.join(sorted(families))}",
            (KEY, i, "family"),
        )
    rest = {key: value for key, value in content.items() if key not in OWN_KEYS}
    return read_record(file, rest, families[stage.family], units, (KEY, i))
