# SPDX-License-Identifier: Apache-2.0
"""The assembly of a chain: those of its stages, with the stage before each name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import (
    AXES,
    BASE,
    Address,
    Assembly,
    AttachedStage,
    Limb,
    LinearMap,
    SharedMap,
)
from loopcal.parameters import CommonError
from loopcal.typing import FloatArray


class StageError(MechanismError):
    """An impossible stage of a chain; `index` is its place in the list of stages."""

    def __init__(self, sentence: str, index: int) -> None:
        super().__init__(sentence)
        self.index = index


@dataclass(frozen=True)
class StageMap:
    """A shared map of a stage, with the names of the chain.

    inputs, outputs : as in `SharedMap`. own : the map of the stage.
    """

    inputs: tuple[str, ...]
    outputs: tuple[Address, ...]
    own: SharedMap

    def value(self, inputs: FloatArray) -> FloatArray:
        """Return the value of the stage's own map."""
        return self.own.value(inputs)

    def jacobian(self, inputs: FloatArray) -> FloatArray:
        """Return the derivative of the stage's own map."""
        return self.own.jacobian(inputs)


def check_stage_names(names: Sequence[str], parents: Sequence[str | None]) -> list[str]:
    """Return what each stage is attached to: BASE, or an earlier stage.

    Parameters
    ----------
    parents : stated for each stage; None for the previous one.

    Raises
    ------
    StageError
        Duplicate or reserved names, a stage on an unknown or later one, or a cycle of stages.
    """
    if not names:
        raise StageError("there are no stages; list those of the chain, from the base on", 0)
    for i, name in enumerate(names):
        if name in names[:i]:
            raise StageError(f"two stages are called {name!r}; give each its own name", i)
        if name == BASE or "." in name or ":" in name or not name:
            raise StageError(
                f"a stage cannot be called {name!r}; choose a name without a point or colon, other "
                f"than {BASE!r}",
                i,
            )
    previous = [BASE, *names]
    stated = [previous[i] if on is None else on for i, on in enumerate(parents)]
    for i, on in enumerate(stated):
        if on not in (BASE, *names):
            raise StageError(
                f"stage {names[i]!r} is on {on!r}, which is not a stage"
                f"{suggest_names(on, names[:i])}; allowed are {', '.join((BASE, *names[:i]))}",
                i,
            )
    for i, on in enumerate(stated):
        if on in names[i:]:
            _refuse_later(names, stated, i)
    return stated


def _refuse_later(names: Sequence[str], parents: Sequence[str], i: int) -> None:
    """Refuse a stage that is attached to a later one, or through others to itself."""
    path, on = [names[i]], parents[i]
    while on != BASE and on not in path:
        path.append(on)
        on = parents[names.index(on)]
    if on == names[i]:
        circle = " on ".join([*path, on])
        raise StageError(
            f"the stages form a cycle: {circle}; attach one of them to {BASE!r} or to an earlier "
            "stage",
            i,
        )
    raise StageError(
        f"stage {names[i]!r} is on {parents[i]!r}, which is listed behind it; list "
        f"{parents[i]!r} first",
        i,
    )


def join_stages(
    name: str,
    stages: Sequence[AttachedStage],
    *,
    controlled: tuple[str, ...],
    tool: FloatArray,
    workspace: dict[str, tuple[float, float]],
    source: str,
) -> Assembly:
    """Return the assembly of a chain; its home is that of its stages, and is found when it is
    compiled.

    Raises
    ------
    StageError
        A stage without actuators, or an actuator of two stages.
    """
    _refuse_wrong_drives(stages)
    assemblies = [(stage.name, stage.assembly) for stage in stages]
    return Assembly(
        name,
        tuple(_rename_limb(prefix, limb) for prefix, part in assemblies for limb in part.limbs),
        tuple(actuator for _, part in assemblies for actuator in part.actuators),
        AXES,
        controlled,
        stages[-1].mount,
        tuple(
            replace(parameter, name=f"{prefix}.{parameter.name}")
            for prefix, part in assemblies
            for parameter in part.parameters
        ),
        tuple(
            _rename_map(prefix, part, entry) for prefix, part in assemblies for entry in part.maps
        ),
        tuple(
            StageMap(
                tuple(f"{prefix}.{name}" for name in shared.inputs),
                tuple(_rename_address(prefix, part, address) for address in shared.outputs),
                shared,
            )
            for prefix, part in assemblies
            for shared in part.shared
        ),
        tool,
        workspace,
        source,
        tuple(f"{prefix}.{name}" for prefix, part in assemblies for name in part.stored_parameters),
        tuple(
            CommonError(
                f"{prefix}.{error.name}",
                tuple(f"{prefix}.{name}" for name in error.parameters),
                error.tolerance,
            )
            for prefix, part in assemblies
            for error in part.common_errors
        ),
        tuple(stages),
    )


def _refuse_wrong_drives(stages: Sequence[AttachedStage]) -> None:
    """Raise StageError for a stage without actuators, and for an actuator of two stages."""
    owner: dict[str, str] = {}
    for i, stage in enumerate(stages):
        if not stage.assembly.actuators:
            raise StageError(
                f"stage {stage.name!r} has no actuators; name the drive of one of its joints, or "
                "make it part of the mount of the next stage",
                i,
            )
        own = dict.fromkeys(n for a in stage.assembly.actuators for n in (a.name, *a.driven_joints))
        for drive in own:
            if drive in owner:
                raise StageError(
                    f"actuator {drive!r} drives the stages {owner[drive]!r} and {stage.name!r}; "
                    "give each stage its own drives",
                    i,
                )
        owner |= dict.fromkeys(own, stage.name)


def _rename_limb(prefix: str, limb: Limb) -> Limb:
    """Return a limb with the name of its stage before its own."""
    return replace(limb, name=f"{prefix}.{limb.name}")


def _rename_map(prefix: str, part: Assembly, entry: LinearMap) -> LinearMap:
    """Return a map with the names of the chain."""
    address = _rename_address(prefix, part, entry.address)
    return replace(entry, parameter=f"{prefix}.{entry.parameter}", address=address)


def _rename_address(prefix: str, part: Assembly, address: Address) -> Address:
    """Return an address with the names of the chain; actuators keep theirs."""
    if address.element == "transmission" and address.owner in {a.name for a in part.actuators}:
        return address
    return replace(address, owner=f"{prefix}.{address.owner}")
