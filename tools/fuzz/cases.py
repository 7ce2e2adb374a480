# SPDX-License-Identifier: Apache-2.0
"""One input, made from its seed: damaged files of a machine, and a command line that reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import PurePosixPath
from random import Random
from typing import Any

import click

from tools.fuzz.arrays import mutate_arrays
from tools.fuzz.commands import draw_options, draw_value, find_group_command, list_commands
from tools.fuzz.corpus import Machine, parse_yaml
from tools.fuzz.stores import mutate_store
from tools.fuzz.surroundings import draw_surroundings
from tools.fuzz.tables import Table, mutate_table, read_table, write_table
from tools.fuzz.texts import mutate_text
from tools.fuzz.trees import Trees, mutate_tree, write_json, write_yaml

MACHINE_WEIGHTS = {"five-bar": 4, "linear-delta": 4, "exports": 2, "programs": 4, "study": 2}
"""How often a machine is drawn, 1 by default. The small ones cost least."""

SURROUNDED = 0.1
"""Share of the inputs that also run beside files and variables of other programs."""

ODD_PLACES = ("missing", "folder", "fifo", "loop", "link", "empty")
"""What may stand in place of an input file."""


@dataclass
class Case:
    """An input.

    Attributes
    ----------
    words : command line. files : content by name; a word of ODD_PLACES for what is no file.
    damage : what was done, as `kind of file: mutation`.
    foreign, variables : files of other programs and variables, which must not change the answer.
    """

    seed: int
    machine: str
    words: list[str]
    files: dict[str, bytes | str]
    damage: list[str] = field(default_factory=list)
    foreign: dict[str, bytes] = field(default_factory=dict)
    variables: dict[str, str] = field(default_factory=dict)


@dataclass
class Maker:
    """Makes inputs from seeds; holds the parsed files of all machines."""

    machines: Sequence[Machine]

    @cached_property
    def commands(self) -> dict[str, click.Command]:
        """Every command by name."""
        return list_commands()

    @cached_property
    def trees(self) -> Trees:
        """What the YAML and JSON files of all machines contain."""
        return Trees(tree for machine in self.machines for tree in machine.trees.values())

    @cached_property
    def tables(self) -> dict[tuple[str, str], Table]:
        """The CSV files of all machines, by machine and name."""
        return {
            (machine.name, name): read_table(content, parse_yaml)
            for machine in self.machines
            for name, content in machine.files.items()
            if name.endswith(".csv") and b";" not in content
        }

    def make(self, seed: int) -> Case:
        """Return the input of a seed."""
        rng = Random(seed)
        weights = [MACHINE_WEIGHTS.get(machine.name, 1) for machine in self.machines]
        machine = rng.choices(self.machines, weights)[0]
        line = rng.choices(machine.lines, [line.weight for line in machine.lines])[0]
        case = Case(seed, machine.name, list(line.words), dict(machine.files))
        if rng.random() < 0.45:
            self._mutate_options(case, machine, rng)
        damages = rng.choices([0, 1, 2, 3, 6], [6, 60, 20, 10, 4])[0]
        for _ in range(damages if case.damage else max(damages, rng.random() < 0.95)):
            self._mutate_file(case, machine, rng)
        if rng.random() < SURROUNDED:
            case.foreign, case.variables = draw_surroundings(rng)
            case.damage += [f"surroundings: {name}" for name in (*case.foreign, *case.variables)]
        return case

    def _mutate_options(self, case: Case, machine: Machine, rng: Random) -> None:
        """Add options, drop a word, or replace one."""
        command = self.commands.get(case.words[0]) or find_group_command(case.words)
        assert command is not None, case.words
        files = [*machine.files, "run", "plan"]
        kind = rng.choices(["add", "drop", "replace", "command"], [12, 1, 2, 0.4])[0]
        if kind == "add":
            case.words += draw_options(command, rng, machine.words, files, machine.left_out)
        elif kind == "drop":
            del case.words[rng.randrange(len(case.words))]
        elif kind == "replace":
            kinds: list[click.ParamType] = [click.Path(), click.STRING, click.INT]
            i = rng.randrange(1, len(case.words) + 1)
            case.words[i : i + 1] = [draw_value(rng.choice(kinds), rng, machine.words, files)]
        else:
            case.words[0] = rng.choice([*self.commands, "Calibrate", "--help", ""])
        case.damage.append(f"options: {kind}")

    def _mutate_file(self, case: Case, machine: Machine, rng: Random) -> None:
        """Damage one of the files that the command line reads."""
        used = list_used_files(case, machine)
        if not used:
            return
        name = rng.choice(used)
        content = case.files[name]
        if isinstance(content, str):
            return
        if rng.random() < 0.015:
            case.files[name] = rng.choice(ODD_PLACES)
            case.damage.append(f"{kind_of(name)}: {case.files[name]}")
            return
        is_structured = content == machine.files[name] and rng.random() < 0.72
        mutated, mutation = (
            self._damage(name, machine, rng, case) if is_structured else None
        ) or mutate_text(content, rng)
        case.files[name] = mutated
        case.damage.append(f"{kind_of(name)}: {mutation}")

    def _damage(
        self, name: str, machine: Machine, rng: Random, case: Case
    ) -> tuple[bytes, str] | None:
        """Return a file with damaged structure; None where its structure is not known."""
        times, mutation = rng.choice([1, 1, 1, 2, 3]), ""
        if name.endswith(".npz"):
            return mutate_arrays(machine.files[name], rng)
        if name.endswith(".sqlite"):
            return mutate_store(machine.files[name], rng)
        if name in machine.trees:
            tree: Any = machine.trees[name]
            for _ in range(times):
                tree, mutation = mutate_tree(tree, rng, self.trees)
            text = write_json(tree) if name.endswith(".json") else write_yaml(tree, rng)
            return text.encode("utf-8", "surrogatepass"), mutation
        if (machine.name, name) in self.tables:
            table = self.tables[machine.name, name]
            for _ in range(times):
                table, mutation = mutate_table(table, rng, self.trees)
            content, settings = write_table(table, rng)
            if settings is not None:
                case.files[str(PurePosixPath(name).with_suffix(".yaml"))] = settings
                case.damage.append("settings: beside the table")
            return content, mutation
        return None


def list_used_files(case: Case, machine: Machine) -> list[str]:
    """Return the files that the words name, those of folders and those named by other files."""
    used = [
        name
        for word in case.words
        for name in machine.files
        if name == word or name.startswith(word + "/")
    ]
    if "run" in case.words:
        used += ["run/result.json"] * 2 + ["run/arrays.npz"] * 2 + ["data.csv", "robot.yaml"]
    if "values.csv" in used:
        used.append("poses.csv")
    return [name for name in used if name in machine.files]


def kind_of(name: str) -> str:
    """Return what sort of file a name denotes, for counting."""
    path = PurePosixPath(name)
    if path.parts[0] in ("run", "plan"):
        return f"{path.parts[0]}/{path.name}"
    if path.suffix in (".yaml", ".json", ".urdf", ".hal", ".g", ".cfg", ".txt"):
        return path.name if path.suffix == ".yaml" else f"*{path.suffix}"
    return "measurements" if path.suffix == ".csv" else path.name
