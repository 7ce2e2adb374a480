# SPDX-License-Identifier: Apache-2.0
"""Valid files of every kind and command lines that read them, made by loopcal itself.

A `Machine` is a folder: a robot, what was measured on it, its run and its plan, and the files of
other programs that describe it. Robots and tables are small, so that an input costs milliseconds.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from loopcal.cli.entry_point import main
from loopcal.io.core import yaml_file
from loopcal.io.runs.certificate import read_template
from loopcal.measure.kinds import KINDS
from tools.fuzz.sources import SOURCES

ROOT = Path(__file__).resolve().parent.parent.parent
EXAMPLES = ROOT / "examples"


@dataclass(frozen=True)
class Line:
    """A command line whose words name files of the machine; `weight` is how often it is drawn."""

    words: tuple[str, ...]
    weight: float = 1.0


@dataclass
class Machine:
    """Files by name, command lines that read them, and words that its options may take."""

    name: str
    files: dict[str, bytes] = field(default_factory=dict)
    lines: list[Line] = field(default_factory=list)
    words: list[str] = field(default_factory=list)
    trees: dict[str, Any] = field(default_factory=dict)
    """Files by name, parsed: YAML and JSON."""
    left_out: frozenset[str] = frozenset()
    """Options that are not added to its command lines."""


@dataclass(frozen=True)
class Recipe:
    """How a machine is made: its robot, the instrument, and the kinds of its other data files."""

    robot: str
    instrument: str
    targets: str
    kinds: Sequence[str] = ()
    formats: Sequence[str] = ()
    words: str = ""


RECIPES = (
    Recipe(
        "five-bar",
        "--kind component --components x,y --sigma-position 20um",
        "pose,x [mm],y [mm]\na,10,320\nb,-50,350\nc,0,300\n",
        ("component", "position", "distance", "plane", "line", "sphere", "separation"),
        words="left right west.motor.x west east x,y left,right",
    ),
    Recipe(
        "linear-delta",
        "--kind position --sigma-position 20um",
        "pose,x [mm],y [mm],z [mm]\na,10,20,100\nb,-50,30,20\n",
        ("position", "bearing", "plane", "separation", "distance"),
        ("klipper", "marlin", "reprap"),
        "q1 q2 radius q3 tower1.stop arm*.length x,y,z z",
    ),
    Recipe(
        "3-prs",
        "--kind pose --orientation tilt-torsion --sigma-position 5um --sigma-angle 20urad",
        "pose,z [mm],phi [deg],theta [deg]\na,700,10,5\nb,690,-50,20\n",
        ("pose", "inclination", "direction", "autocollimation"),
        words="q1 q2 l1 q3 z phi theta z,phi,theta chain1.a",
    ),
    Recipe(
        "hexapod-octahedral",
        "--kind pose --sigma-position 5um --sigma-angle 20urad",
        "pose,x [mm],y [mm],z [mm],roll [deg],pitch [deg],yaw [deg]\na,1,2,300,1,2,3\n",
        ("inclination",),
        words="q1 q6 leg1.length leg*.base.x base,tool x,y,z,phi,theta,psi",
    ),
    Recipe(
        "cable-4",
        "--kind position --sigma-position 1mm --sigma-reading 1deg",
        "pose,x [mm],y [mm],z [mm]\na,10,20,300\nb,-50,30,200\n",
        ("closure",),
        words="a b A.anchor.x c d",
    ),
)
"""Machines with a calibration of their own."""

PLANNED = ("five-bar", "linear-delta")
"""Machines with a plan; planning the others would take longer than all the rest."""


def build_corpus() -> list[Machine]:
    """Return all machines; their files are made anew in a temporary folder.

    From here on, this process keeps all that YAML texts contain, not only the latest of them: the
    workers, its forks, parse no undamaged file again.
    """
    yaml_file._compose = lru_cache(4096)(yaml_file._compose.__wrapped__)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        return [*(_build_machine(recipe) for recipe in RECIPES), *_build_sources()]


def run_command(command: str, is_needed: bool = True) -> bool:
    """Run a command silently and return whether it succeeded; RuntimeError where it must."""
    with (
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()) as said,
    ):
        code = main(command.split())
    if code != 0 and is_needed:
        raise RuntimeError(f"loopcal {command}: {said.getvalue()}")
    return code == 0


def collect_files(machine: Machine, folder: str) -> Machine:
    """Take the files of a folder into a machine, and what they contain."""
    for path in sorted(Path(folder).rglob("*")):
        if path.is_file() and path.suffix not in (".png", ".pdf", ".svg"):
            name = path.relative_to(folder).as_posix()
            machine.files[name] = path.read_bytes()
            if path.suffix in (".yaml", ".json"):
                parse = json.loads if path.suffix == ".json" else parse_yaml
                machine.trees[name] = parse(machine.files[name].decode())
    return machine


def parse_yaml(text: str) -> Any:
    """Return a YAML or JSON text as plain mappings and lists."""
    from ruamel.yaml import YAML

    return YAML(typ="safe", pure=True).load(text)


@contextlib.contextmanager
def work_in_folder(name: str) -> Iterator[str]:
    """Work in a folder of this name."""
    Path(name).mkdir()
    with contextlib.chdir(name):
        yield name


def _build_machine(recipe: Recipe) -> Machine:
    """Make a robot, its data, its run and its plan, and the lines that use them."""
    name = recipe.robot
    words = [*recipe.words.split(), "a", "1", "2", "fitted", "base", name]
    # a followed export is waited for
    machine = Machine(name, words=words, left_out=frozenset({"--follow"}))
    with work_in_folder(name):
        shutil.copy(ROOT / "src" / "loopcal" / "robots" / f"{name}.yaml", "robot.yaml")
        seen = f"simulate robot.yaml --draw-errors {recipe.instrument}"
        draw = 30 if name == "hexapod-octahedral" else 14
        run_command(f"{seen} --draw {draw} --seed 2 -o data.csv --truth truth.yaml")
        run_command(f"simulate truth.yaml {recipe.instrument} --draw 7 --seed 3 -o more.csv")
        run_command("calibrate robot.yaml data.csv -o run --hold-out 0.3")
        run_command("calibrate robot.yaml more.csv -o later", is_needed=False)
        Path("facts.yaml").write_text(read_template().replace(': ""', ": A1"), "utf-8")
        Path("targets.csv").write_text(recipe.targets, "utf-8")
        planned = "--poses 8 --hold-out 2 --candidates 16"
        if name in PLANNED:
            run_command(f"plan robot.yaml -o plan {planned} {_planning_options(recipe)}")
        _split_readings()
        for kind in recipe.kinds:
            run_command(
                f"simulate robot.yaml --kind {kind} --draw 8 -o {kind}.csv", is_needed=False
            )
        for ending in recipe.formats:
            run_command(f"export robot.yaml --format {ending} -o {ending}.cfg", is_needed=False)
        machine.lines = [*_list_lines(recipe)]
    return collect_files(machine, name)


def _planning_options(recipe: Recipe) -> str:
    """Return the options of an instrument that `plan` has."""
    words = recipe.instrument.split()
    return " ".join(w for i, w in enumerate(words) if "--sigma-reading" not in (w, words[i - 1]))


def _split_readings() -> None:
    """Write the readings and the values of data.csv as two files, one of which names the other."""
    lines = Path("data.csv").read_text("utf-8").splitlines()
    settings = [line for line in lines if line.startswith("#")]
    rows = [line.split(",") for line in lines if not line.startswith("#")]
    n = next((i for i, name in enumerate(rows[0]) if name.split(" ")[0] in VALUES), len(rows[0]))
    poses = [",".join(row[:n]) for row in rows]
    values = [",".join([row[0], *row[n:]]) for row in rows]
    Path("poses.csv").write_text("\n".join(poses) + "\n", "utf-8")
    text = "\n".join([*settings, "# poses: poses.csv", *values]) + "\n"
    Path("values.csv").write_text(text, "utf-8")


VALUES = ("x", "y", "z", "phi", "rx")
"""Columns with which measured values begin."""


def _list_lines(recipe: Recipe) -> Iterator[Line]:
    """Yield the command lines of a machine that has been calibrated."""
    few = "--poses 8 --hold-out 1 --candidates 12"
    plan, name = _planning_options(recipe), recipe.words.split()[2]
    volume = "z=695mm..705mm" if recipe.robot == "3-prs" else "x=-5mm..5mm"
    if recipe.robot.startswith("hexapod"):
        yield Line(("per-leg", "robot.yaml", "data.csv"), 2)
    sheet = "plan/measurements.csv" if recipe.robot in PLANNED else "more.csv"
    table = f"""
        6 check robot.yaml
        1 check robot.yaml --expand
        1 check robot.yaml --json
        0.1 check robot.yaml --plot picture.svg
        2 simulate robot.yaml --draw 6 -o out.csv {recipe.instrument}
        2 simulate robot.yaml --poses targets.csv -o out.csv {recipe.instrument}
        2 simulate robot.yaml --fill {sheet} --draw-errors --truth t.yaml -o out.csv
        1 simulate run/robot.yaml --draw 6 -o out.csv {recipe.instrument}
        6 identifiability robot.yaml data.csv
        1 identifiability robot.yaml --poses targets.csv {plan}
        1 identifiability robot.yaml data.csv --fix-unidentifiable -o reduced.yaml
        2 regularize robot.yaml data.csv
        1 regularize robot.yaml data.csv -o out --folds 2 --json
        3 calibrate robot.yaml data.csv -o out --hold-out 0.3
        1 calibrate robot.yaml data.csv -o out --hold-out 0.3 --json
        1 calibrate robot.yaml values.csv -o out
        1 calibrate robot.yaml poses.csv values.csv -o out --hold-out 0.3
        1 calibrate robot.yaml more.csv -o out --prior run
        1 calibrate robot.yaml data.csv -o run --force
        1 calibrate robot.yaml more.csv -o out --compare truth.yaml
        5 validate run more.csv
        1 validate run/robot.yaml more.csv
        0.2 schema robot
        0.2 schema study -o out.json
        4 budget run
        1 budget run --json
        0.3 report run -o out.html
        0.3 report run -o out.html --json
        0.3 view robot.yaml -o out.html --no-browser
        0.3 view run -o out.html --no-browser --json
        1 compare run later
        0.5 compare run later --data more.csv --json
        1 check-up run more.csv
        0.5 check-up run more.csv data.csv -o out.svg
        0.5 measure {sheet} --robot robot.yaml -o out
        1 repeatability robot.yaml data.csv
        1 certificate run facts.yaml
        1 accuracy run --volume {volume}
        0.5 accuracy run --volume {volume} --frame base --json
        5 compensate run targets.csv -o out.csv
        1 compensate run targets.csv --mode commands
        1 compensate truth.yaml targets.csv -o out.csv --json
        1 bootstrap run --count 6
        0.5 bootstrap robot.yaml data.csv --count 6 -o out.csv
        0.5 sample run --count 100 -o out.csv
        2 sample run --region -p {name}
        1 sample robot.yaml data.csv --region
        0.15 plan robot.yaml -o out {few} {plan}
        0.1 plan robot.yaml -o out {few} --like data.csv --measured more.csv
        0.15 plan robot.yaml -o plan {few} --allowed targets.csv --force
        0.5 gcode robot.yaml plan -o out.ngc
        0.1 board -o board.yaml
        0.1 photos plan --board board.yaml -o out.csv
        2 export run -o out.json
        1 export run -o out.csv
        1 export run/robot.yaml -o out.json
        """
    for line in table.strip().splitlines():
        weight, *words = line.split()
        yield Line(tuple(words), float(weight))
    for kind in recipe.kinds:
        if Path(f"{kind}.csv").exists():
            yield Line(("identifiability", "robot.yaml", f"{kind}.csv"), 0.7)
            yield Line(
                ("calibrate", "robot.yaml", f"{kind}.csv", "-o", "out", "--method", "map"), 0.5
            )
            yield Line(("validate", "truth.yaml", f"{kind}.csv"), 0.5)
    for ending in recipe.formats:
        file = f"{ending}.cfg"
        yield Line(("import", file, "--format", ending, "-o", "new.yaml"))
        yield Line(
            ("export", "run", "--format", ending, "--into", file, "-o", "corrected.cfg"), 0.7
        )


def _build_sources() -> Iterator[Machine]:
    """Yield the machines that come from files of other programs, and commands without a machine."""
    with work_in_folder("exports"):
        for folder in ("exports", "hexapod-tracker"):
            for path in sorted((EXAMPLES / folder).iterdir()):
                if path.suffix != ".md":
                    shutil.copy(path, path.name)
        pairs = (
            ("tracker-points.txt", "tracker-points"),
            ("six-dof.txt", "six-dof"),
            ("cmm-spheres.csv", "cmm-spheres"),
        )
        lines = [
            Line(("import", file, "--profile", f"{profile}.yaml", "-o", "out.csv"), 3)
            for file, profile in pairs
        ]
        filling = "fill hexapod.yaml sheet.csv points.txt --profile spatial-analyzer -o out.csv"
        lines.append(Line(tuple(filling.split())))
        lines.append(Line((*filling.split(), "--by-order", "--allow-implausible"), 0.5))
        lines.append(Line(("gcode", "hexapod.yaml", "plan.csv", "-o", "out.ngc")))
        lines.append(Line(("export", "hexapod.yaml", "--into", "machine.ini", "-o", "out.ini")))
    yield collect_files(Machine("exports", lines=lines, words=["SMR1", "1"]), "exports")
    with work_in_folder("programs"):
        for name, text in SOURCES.items():
            Path(name).write_text(text, "utf-8")
        shutil.copy(EXAMPLES / "cable-robot" / "samples.json", "samples.json")
        table = """
            3 import printer.cfg -o new.yaml --data new.csv
            1 import printer.cfg -o new.yaml --data new.csv --corrected corrected.cfg
            2 import robot.g --format reprap -o new.yaml
            2 import marlin.g --format marlin -o new.yaml
            3 import hexapod.hal --unit mm --home-z 200mm -o new.yaml
            3 import samples.json --format hangprinter -o new.yaml --data new.csv
            3 import robot.urdf --closures loops.yaml -o new.yaml
            3 import constrained.urdf -o new.yaml
            1 export five-bar -o out.csv
            1 export linear-delta --format klipper --into printer.cfg -o corrected.cfg
            1 export linear-delta --format reprap --into robot.g -o corrected.g
            1 export hexapod-42 --format linuxcnc --into hexapod.hal -o corrected.hal
            1 new limbs -o new.yaml --measurements new.csv --kind position,inclination
            1 new gough -o new.yaml
            0.2 new --report-facts new-facts.yaml
            0.2 completion bash
            0.2 example cable-robot -o out
            0.5 reproduce
            0.05 reproduce tsvd-2016 --trials 1 -o out
            """
        lines = [
            Line(tuple(line.split()[1:]), float(line.split()[0]))
            for line in table.strip().splitlines()
        ]
    words = ["base", "tip", "platform", *KINDS, "linear-delta", "3-prs", "hexapod-42", "tsvd-2016"]
    yield collect_files(Machine("programs", lines=lines, words=words), "programs")
