# SPDX-License-Identifier: Apache-2.0
"""Arguments and options of the commands, and what several commands do with them.

A command is a function whose arguments have declarations as defaults: the option --max-tilt is
`max_tilt: float | None = option("Largest tilt ...", type=ANGLE)`. What options state together, such
as the settings of a fit, is a `Group`: one argument, which the function receives as one value.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from importlib import import_module
from inspect import cleandoc, signature
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

import loopcal as lc
from loopcal.cli import terminal
from loopcal.errors import DataError, LoopcalError, UnitError, suggest_names
from loopcal.registry import Registry
from loopcal.units import Dimension, find_unit, parse_goal, parse_number, parse_quantity

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from loopcal.typing import FloatArray


@dataclass(frozen=True)
class Declared:
    """A parameter of a command, without the name of the argument that it is the default of."""

    kind: type[click.Parameter]
    names: tuple[str, ...]
    settings: Mapping[str, Any]

    def build(self, name: str) -> click.Parameter:
        """Return the parameter; an option without a long name gets that of the argument."""
        names = self.names
        if self.kind is not click.Argument and not any(n.startswith("--") for n in names):
            names = (*names, f"--{name.replace('_', '-')}")
        return self.kind([name, *names], **self.settings)


class Group:
    """Parameters that a function takes as one argument: what `make` returns of their values."""

    def __init__(
        self, make: Callable[[Mapping[str, Any]], Any] = dict, /, **members: Declared
    ) -> None:
        self.make, self.members = make, members


def command(
    name: str | None = None, of: click.Group | None = None
) -> Callable[[Callable[..., terminal.Output]], click.Command]:
    """Return a decorator that makes a command of a function that declares its options; `of` is the
    group that the command belongs to. Every command has the option --json.
    """

    def declare(function: Callable[..., terminal.Output]) -> click.Command:
        declared = {key: entry.default for key, entry in signature(function).parameters.items()}
        groups = {key: entry for key, entry in declared.items() if isinstance(entry, Group)}

        @wraps(function)
        def run(as_json: bool, **values: Any) -> int:
            for key, group in groups.items():
                values[key] = group.make({member: values.pop(member) for member in group.members})
            return terminal.print_output(function(**values), as_json)

        members: dict[str, Declared] = {}
        for key, entry in declared.items():
            members |= entry.members if isinstance(entry, Group) else {key: entry}
        members["as_json"] = flag("Print one JSON document instead of text.", "--json")
        parameters = [entry.build(key) for key, entry in members.items()]
        text = cleandoc(function.__doc__ or "")  # click does not wrap what follows a "\b"
        text = re.sub(r"(?<=\n\n)(?=\S.*\n )", "\b\n", text)
        return (of or click).command(name, params=parameters, help=text)(run)

    return declare


def look_up(place: str) -> Any:
    """Return what a place such as `package.module:NAME` names."""
    module, _, name = place.partition(":")
    return attrgetter(name)(import_module(module))


class LibraryOption(click.Option):
    """An option that asks the library when it is used: for its default, which is the constant at
    the place `of`, or that of the function or record of options there under the same name, and for
    its help text where this is a function.
    """

    def __init__(self, *arguments: Any, of: str = "", **settings: Any) -> None:
        self.write_help: str | Callable[[], str] = settings.pop("help")
        self.of = of
        super().__init__(*arguments, **settings)

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the option and its help text, for the help."""
        self.help = self.write_help() if callable(self.write_help) else self.write_help
        return super().get_help_record(ctx)

    def get_default(self, ctx: click.Context, call: bool = True) -> Any:
        """Return the default; for the help (without `call`) as a text."""
        if not self.of:
            return super().get_default(ctx, call)
        value = look_up(self.of)
        if callable(value):
            value = signature(value).parameters[self.name or ""].default
        return self.type.show(value) if not call and isinstance(self.type, Parsed) else value


def argument(metavar: str | None = None, **settings: Any) -> Any:
    """Declare an argument of the command line."""
    return Declared(click.Argument, (), {"metavar": metavar, **settings})


def option(help: str | Callable[[], str], *names: str, **settings: Any) -> Any:  # noqa: A002
    """Declare an option, with other names than that of the argument; `of` is the place in the
    library that states its default, see `LibraryOption`.
    """
    return Declared(LibraryOption, names, {"help": help, **settings})


def path(help: str, *names: str, **settings: Any) -> Any:  # noqa: A002
    """Declare an option that takes the path of a file or folder."""
    return option(help, *names, type=FILE, **settings)


def flag(help: str, *names: str) -> Any:  # noqa: A002
    """Declare an option without a value."""
    return option(help, *names, is_flag=True)


def force(what: str, more: str = "") -> Any:
    """Declare the option that lets a command replace what exists, and `more`."""
    exists = "they exist" if what.endswith("files") else "it exists"
    return flag(f"Replace {what} if {exists}{more}.")


def seed(what: str, of: str) -> Any:
    """Declare the option for the seed of something random, which a function `of` makes."""
    return option(f"Seed of {what}.", of=of, type=Count(least=0), metavar="N")


# Types of values


class Parsed(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """Text of the command line that a function reads; it raises LoopcalError with what is allowed.

    show : returns a value as text of the command line, for a default in a help text.
    """

    def __init__(
        self, name: str, parse: Callable[[str], Any], show: Callable[[Any], str] = str
    ) -> None:
        self.name, self.parse, self.show = name, parse, show

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value, or fail with what is allowed."""
        try:
            return self.parse(value) if isinstance(value, str) else value
        except LoopcalError as error:
            self.fail(str(error), param, ctx)


def _quantity(dimension: Dimension, is_positive: bool = False) -> Parsed:
    """Return the type of a number with its unit, such as 0.02mm; its value is in SI."""

    def parse(text: str) -> float:
        number = parse_quantity(text, dimension)
        if is_positive and not number > 0.0:
            raise UnitError(f"{text!r} is not above 0. Give a positive number")
        return number

    def show(value: float) -> str:
        unit = "mm"
        if dimension is Dimension.ANGLE:
            unit = "deg" if value > 1e-3 else "urad"
        return f"{value / find_unit(unit).factor_to_si:g}{unit}"

    return Parsed("quantity", parse, show)


def _parse_condition(text: str) -> tuple[str, float]:
    """Return the name of a condition and its value [degC, s, N, Nm]."""
    name, _, value = text.partition("=")
    dimension = {d.value: d for d in Dimension}.get(name.partition(".")[0])
    if dimension is None or not value:
        raise UnitError(f"{text!r} is not a condition. Write temperature=35 or force.z=-500N")
    number = parse_number(value)
    return name, parse_quantity(value, dimension) if number is None else number


def _parse_pose_share(text: str) -> float:
    """Return a share of the poses, from 0 to below 1; an error says what was probably meant."""
    from loopcal.apply.calibration_options import describe_wrong_share

    try:
        share = float(text)
    except ValueError:
        allowed = "a share of the poses is a number from 0 to below 1, such as 0.25 for 25 %"
        raise DataError(f"{text!r} is not a number: {allowed}.") from None
    if fault := describe_wrong_share(share):
        raise DataError(f"it is {fault}.")
    return share


Parts = tuple[tuple[str, Any], ...]  # of a volume, see `loopcal.apply.volume_accuracy`
FILE = click.Path(path_type=Path)
LENGTH, POSITIVE_LENGTH = (_quantity(Dimension.LENGTH, positive) for positive in (False, True))
ANGLE, POSITIVE_ANGLE = (_quantity(Dimension.ANGLE, positive) for positive in (False, True))
GOAL = Parsed("quantity", parse_goal)
NAMES = Parsed("names", lambda text: tuple(text.split(",")), ",".join)
CONDITION = Parsed("condition", _parse_condition)
POSE_SHARE = Parsed("share", _parse_pose_share)


class NumberRange(click.FloatRange):
    """A finite number within a range."""

    name = "number"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the number, or fail with what is allowed."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


POSITIVE = NumberRange(0, min_open=True)
SHARE, OPEN_SHARE = (NumberRange(0, 1, is_open, is_open) for is_open in (False, True))
SHARE.name = OPEN_SHARE.name = "share"


class Count(click.IntRange):
    """A whole number on the command line, up to a limit of `loopcal.io.core.limits`, which is given
    by its name, so that it is only imported when the option is used; without `least`, the command
    itself refuses small ones.
    """

    name = "integer"

    def __init__(self, limit: str = "", least: int | None = None, most: int | None = None) -> None:
        super().__init__(min=least, max=most)
        self.limit = limit

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Return the word for a value in the help."""
        return "N"

    def _describe_range(self) -> str:
        """Return the range for the help: click states one without a bound as "x<=None"."""
        return "" if self.min is None else super()._describe_range()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number, or fail with what is allowed."""
        from loopcal.io.core import limits

        number, limit = super().convert(value, param, ctx), getattr(limits, self.limit, None)
        if limit is not None and number > limit.most:
            self.fail(f"the limit is {limit}. Give a smaller number.", param, ctx)
        return int(number)


class Words(click.Choice):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """A word of the library on the command line: of the registry, or `Literal`, at a place, which
    is imported when it is needed, or one of `others`. A `property`, such as `read` of formats,
    leaves only entries of a registry that have it.
    """

    def __init__(self, place: str, *others: str, property: str = "") -> None:  # noqa: A002
        self.place, self.others, self.property = place, others, property
        self.case_sensitive = True

    @property
    def choices(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The words that are allowed, for help texts and messages."""
        words = look_up(self.place)
        if isinstance(words, Registry) and self.property:
            listed = [name for name, entry in words.items() if getattr(entry, self.property)]
        else:
            listed = list(words) if isinstance(words, Registry) else get_args(words)
        return (*self.others, *listed)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the word, the listed one for another name of a registry."""
        if value in self.others:
            return value
        words = look_up(self.place)
        if isinstance(words, Registry) and not self.property and value in words:
            return words.resolve(value)
        return super().convert(value, param, ctx)


# Declarations that several commands have


def complete_robot(
    _context: click.Context, _argument: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the shipped robots that begin as a word; files where there is none."""
    from click.shell_completion import CompletionItem

    from loopcal.io.robot.robot_file import list_shipped_robots

    names = [name for name in list_shipped_robots() if name.startswith(incomplete)]
    return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


def _refuse_yaml(_context: click.Context, _argument: click.Parameter, paths: Any) -> Any:
    """Refuse a YAML file, such as a robot file, in place of measurements."""
    for path in paths if isinstance(paths, tuple) else () if paths is None else (paths,):
        if path.suffix in (".yaml", ".yml"):
            raise DataError(f"{path} is a YAML file. Give a measurement file (CSV)")
    return paths


def data(metavar: str = "DATA...", required: bool = True) -> Any:
    """Declare the argument of measurement files."""
    return argument(metavar, type=FILE, nargs=-1, required=required, callback=_refuse_yaml)


def data_option(help: str, **settings: Any) -> Any:  # noqa: A002
    """Declare an option that takes a measurement file."""
    return path(help, metavar="DATA", callback=_refuse_yaml, **settings)


ROBOT: Any = argument("ROBOT", shell_complete=complete_robot)
RUN: Any = argument("RUN", type=FILE)
AT: Any = option(
    "Today's value of a condition of the robot file, such as temperature=35 or force.z=-500N. "
    "Repeatable.",
    multiple=True,
    type=CONDITION,
    metavar="NAME=VALUE",
)
VERBOSE: Any = flag("Print all findings and tables, not only the summary.", "-v")


def frame(of: str, names: str = "fitted, base, relative, or the frame of an instrument") -> Any:
    """Declare the option for the frame in which a function `of` states errors."""
    help_text = (
        f"Frame of the errors: {names}. 'fitted' is after the best rigid fit of "
        "the base and platform frames, as far as the measurements do not determine them."
    )
    return option(help_text, of=of, metavar="NAME")


def _parse_volume(text: str) -> tuple[str, Any]:
    """Return a part of a volume, or `points` and the file of them."""
    from loopcal.apply.volume_accuracy import POINTS, parse_volume_part

    return (POINTS, Path(text)) if Path(text).is_file() else parse_volume_part(text)


def volume(**settings: Any) -> Any:
    """Declare the option for a working volume, of which `read_volume` makes one value."""
    return option(
        "Volume for the largest position error. x=-40mm..40mm is a range of a controlled "
        "coordinate, radius=40mm a cylinder, theta=0deg,5deg single values. Or a CSV file "
        "of points. Give each part. Other coordinates stay at home.",
        type=Parsed("volume", _parse_volume),
        multiple=True,
        metavar="PART|FILE",
        **settings,
    )


def read_volume(parts: Parts, robot: lc.Mechanism) -> lc.Volume | None:
    """Return the volume that the parts of the command line state together; None without any."""
    from loopcal.apply.volume_accuracy import POINTS, join_volume
    from loopcal.io.runs.result_files import load_targets

    loaded = ((n, load_targets(of, robot)[0] if n == POINTS else of) for n, of in parts)
    return join_volume(loaded) if parts else None


def _limit(kind: Parsed, quantity: str, where: str, example: str) -> Any:
    text = f"Largest allowed {quantity} error on poses that were not fitted{where}"
    return option(f"{text}, such as {example}. Above it the exit code is 2.", type=kind)


LIMIT_POSITION = _limit(POSITIVE_LENGTH, "position", " or in a volume", "0.02mm")
LIMIT_ANGLE = _limit(POSITIVE_ANGLE, "orientation", "", "0.01deg")


def profile(help: str, **settings: Any) -> Any:  # noqa: A002
    """Declare the option for the profile of an export: a file, or the name of a shipped one."""

    def write_help() -> str:
        from loopcal.io.exports.profile import list_shipped_profiles

        names = ", ".join(list_shipped_profiles())
        return f"{help} A file (docs/exports.md), or one of {names}."

    return option(write_help, metavar="FILE|NAME", **settings)


DECIMAL: Any = option(
    "Decimal mark of the export. With comma, semicolons separate columns.  [default: from the "
    "profile]",
    type=click.Choice(("point", "comma")),
)

# Accept suspicious measurements.
ALLOWED: Any = Group(
    allow_still=flag("Accept a target that does not move from pose to pose."),
    allow_outside_stroke=flag("Accept readings outside the stroke of their actuator."),
    allow_implausible=flag(
        "Accept values that fit far better in another unit, order, sign or column."
    ),
    allow_duplicates=flag("Accept rows that copy others, up to rounding."),
)


# What the user stated


def list_words() -> list[str]:
    """Return the words of the command line, for the provenance of a result."""
    return ["loopcal", *click.get_current_context().find_root().obj]


def is_given(name: str) -> bool:
    """Return whether the user stated an option on the command line."""
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def name_option(name: str) -> str:
    """Return the option of the running command that has this name in its function."""
    parameters = click.get_current_context().command.params
    return next(option.opts[-1] for option in parameters if option.name == name)


def refuse_given(
    names: Iterable[str],
    reason: str,
    sentence: str = "{option} has no effect {reason}. Leave it out",
) -> None:
    """Raise DataError for the first of these options that the user stated; the reason is a clause
    of the sentence, such as "because ..." or "with --profile".
    """
    for name in names:
        if is_given(name):
            raise DataError(sentence.format(option=name_option(name), reason=reason))


# Robots and measurements


def open_robot(
    robot: str, outputs: Iterable[Path | None], inputs: Iterable[Path | None], force: bool
) -> lc.Mechanism:
    """Return a robot; refuse outputs that exist, or that are its file or another input."""
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.robot.robot_file import find_robot_file, load_robot

    refuse_outputs(tuple(outputs), (find_robot_file(robot), *inputs), force)
    return load_robot(robot)


def read_measurements(
    paths: Sequence[Path], robot: lc.Mechanism, *, is_check: bool = False, **allowed: bool
) -> lc.Measurements:
    """Read measurement files as one set.

    Print a note where a file names another robot, which is refused where it `is_check` of a run, or
    another file by its absolute path, or contains no measured value.
    """
    from loopcal.diagnose.conventions.convention_check import explain_outside_strokes
    from loopcal.io.core.yaml_file import list_absolute_references
    from loopcal.io.data.measurement_file import join_tables, list_unfilled_files, read_tables

    with terminal.TerminalProgress("reading the measurements"):
        tables = read_tables(paths)
    for path, table in zip(paths, tables, strict=False):  # files that they name follow
        settings = table.settings
        for finding in list_absolute_references(settings):
            terminal.print_note(finding)
        stated = str(settings.content.get("robot") or "").strip()
        if stated not in ("", robot.name):
            facts: Any = {"file": str(path), "stated": stated, "used": robot.name}
            if is_check:
                raise DataError.of("checks.other-robot", **facts)
            terminal.print_finding("workflow.robot-of-other-name", **facts)
    try:
        with terminal.TerminalProgress("reading the measurements"):
            data = join_tables(tables, robot, **allowed)
    except DataError as error:
        if error.finding is not None and error.finding.code == "data.outside-stroke":
            accepted = join_tables(tables, robot, **{**allowed, "allow_outside_stroke": True})
            explained = explain_outside_strokes(robot, accepted, error.finding.data)
            if explained is not None:
                text = f"{' and '.join(map(str, paths))}: {explained}"
                raise DataError(text) from DataError(explained)
        raise
    for file in list_unfilled_files(tables, data):
        terminal.print_finding("files.no-measured-value", file=str(file))
    return data


def read_checked_measurements(
    paths: Sequence[Path],
    robot: lc.Mechanism,
    *,
    allow_still: bool = False,
    allow_implausible: bool = False,
    **allowed: bool,
) -> lc.Measurements:
    """Read measurement files as `read_measurements`, and check their conventions."""
    data = read_measurements(paths, robot, **allowed)
    check = lc.check_conventions(
        robot, data, allow_still=allow_still, allow_implausible=allow_implausible
    )
    print_convention_note(check, paths)
    return data


def print_convention_note(check: lc.ConventionCheck, paths: Sequence[Path]) -> None:
    """Print a note where a check of these files leaves a doubt."""
    if check.finding is not None:
        terminal.print_note(f"{' and '.join(map(str, paths))}: {check.finding}")


def read_fitted_measurements(
    paths: Sequence[Path], robot: lc.Mechanism, allowed: Mapping[str, bool]
) -> lc.Measurements:
    """Read the poses that a fit would use, as `ALLOWED`; print a note where others are held out."""
    data = read_checked_measurements(paths, robot, **allowed)
    if count := int(data.is_held_out.sum()):
        terminal.print_finding("data.held-out-not-counted", count=count)
    return data.fitted


# Settings of a fit

_FIT = "loopcal.estimate.options:FitOptions"
RANK_TOLERANCE: Any = option(
    "Share of the largest singular value below which one counts as zero.", of=_FIT, type=OPEN_SHARE
)


def _make_fit_options(stated: Mapping[str, Any]) -> lc.FitOptions:
    """Return the options of the library from those of `FIT`."""
    from loopcal.estimate.options import find_foreign_setting

    if (foreign := find_foreign_setting(stated)) is not None:
        raise DataError(
            f"--{foreign[0]} belongs to --method {foreign[1]}, not to {stated['method']}. Leave it "
            "out, or change the method"
        )
    return lc.FitOptions.from_dict(stated)


def _parse_weights(text: str) -> float | dict[str, float]:
    """Return the weight of ridge, or weights by name or pattern of parameters, also from a file."""
    from loopcal.io.core.yaml_file import read_yaml

    pairs = [part.rpartition("=")[::2] for part in text.split(",")]
    if Path(text).is_file():
        pairs = list(read_yaml(text, "file of weights").content.items())
    try:
        weights = {str(pattern): float(number) for pattern, number in pairs}
    except (TypeError, ValueError):
        weights = {}
    is_unique = len(weights) == len(pairs)
    if not (weights and is_unique) or not all(
        0.0 <= weight < float("inf") for weight in weights.values()
    ):
        raise DataError(
            f"{text!r} is not a list of weights of 0 or more, each pattern once. Write a number, "
            "'*.length=1,*=0.01', or a YAML file with lines '*.length: 1'"
        )
    return weights.pop("") if list(weights) == [""] else weights


def _describe_methods() -> str:
    """Return the methods with their short names, and what they are."""
    from loopcal.estimate.methods import METHODS

    shorts = {name: f" (or {short})" for short, name in METHODS.aliases.items()}
    others = (
        f"{name}{shorts.get(name, '')}: {getattr(method, 'what', '')}".removesuffix(": ")
        for name, method in METHODS.items()
        if name != "auto"
    )
    auto = "auto: map, with inflated expected spreads if the data contradict them"
    return f"{'. '.join((auto, *others))}."


FIT: Any = Group(
    _make_fit_options,
    method=option(
        _describe_methods, type=Words("loopcal.estimate.methods:METHODS"), default="auto"
    ),
    inflation=option(
        "For auto: which expected spreads the fit may inflate. global: all by one factor. groups: "
        "also limbs and types of parameters, and their common deviations. heavy-tailed: also "
        "single parameters. auto, the default: all of these. none: as given.",
        type=Words("loopcal.estimate.tolerance_components:By", "none"),
    ),
    lam=option(
        "For ridge: weight of the penalty. Default: by cross-validation. Or a weight for each "
        "parameter: patterns such as '*.length=1,*=0.01', or a YAML file of such lines '*.length: "
        "1'. The most exact pattern counts. The weight of others is 0.",
        type=Parsed("weight", _parse_weights),
        metavar="WEIGHT",
    ),
    keep=option(
        "For truncated-svd: number of directions. Default: by cross-validation.",
        type=Count(least=0),
        metavar="K",
    ),
    noise=option(
        "Take the given sigmas as true, or estimate one common factor.",
        of=_FIT,
        type=Words("loopcal.estimate.options:Noise"),
    ),
    sigma_uncertainty=option(
        "Relative standard uncertainty of given sigmas, which the intervals include. 0 takes them "
        "as exact.",
        of=_FIT,
        type=SHARE,
    ),
    loss=option(
        "Reduce the weight of poses that are far from the fit.",
        type=Words("loopcal.estimate.losses:LOSSES", "none"),
        default="none",
    ),
    rank_tolerance=RANK_TOLERANCE,
    excluded_poses=option(
        "Exclude this pose from fit and validation. Repeatable.",
        "--drop",
        multiple=True,
        metavar="POSE",
    ),
)

# Instruments

SIMULATION = "loopcal.apply.simulated_measurements"
_INSTRUMENT = f"{SIMULATION}:InstrumentDescription"
# The kind of measurement and its noise, for `make_instrument`.
INSTRUMENT: Any = Group(
    kinds=option(
        "Kind of measurement: pose, component, position, bearing, ..., or several, such as "
        "position,inclination.",
        "--kind",
        of=_INSTRUMENT,
        type=NAMES,
    ),
    components=option(
        "Coordinates that the kind 'component' measures, such as z or x,y,z.", type=NAMES
    ),
    joints=option(
        "Joints that the kinds 'joint' and 'locked' measure: drives, and passive joints as "
        "limb.joint, such as left.rail.",
        type=NAMES,
    ),
    orientation=option(
        "Form of measured angles: rotation-vector, quaternion, tilt-torsion, euler-xyz, ...",
        metavar="FORM",
    ),
    sigma_position=option(
        "Standard deviation of each measured length.", of=_INSTRUMENT, type=POSITIVE_LENGTH
    ),
    sigma_angle=option(
        "Standard deviation of each measured angle.", of=_INSTRUMENT, type=POSITIVE_ANGLE
    ),
    sigma_scale=option(
        "Standard deviation of a common factor on all measured lengths, such as 2ppm.  "
        "[default: none]",
        type=_quantity(Dimension.RATIO, is_positive=True),
    ),
)

# The short form of components, and unknown frames and targets, for `make_instrument`.
UNKNOWN: Any = Group(
    measure=option(
        "Short for --kind component --components NAMES: some of x,y,z,phi,theta,psi. Or camera: "
        "pictures of a printed board, from the best place. In loopcal plan also plane-line: points "
        "on planes with a line.",
        type=NAMES,
    ),
    board=path(
        "With --measure camera: file of the board, by loopcal board. Default: 10 x 7 squares."
    ),
    stations=option(
        "With --measure camera: stations of the camera, from each of which it sees some poses.  "
        "[default: 1]",
        type=Count("STATIONS", 1),
    ),
    unknown_frames=option(
        "Unknown frames: base (the frame of the instrument in the base), tool, or base,tool.",
        "--frames",
        type=NAMES,
    ),
    targets=option(
        "Targets at unknown places on the platform, of a kind such as position: SMR1,SMR2,SMR3.",
        type=NAMES,
    ),
)

DRAW: Any = option(
    "Number of poses to draw evenly from the workspace, without other poses.",
    of=f"{SIMULATION}:DRAWN",
    type=Count("DRAWN_POSES", 1),
)

EPSILON: Any = option(
    "End the steps when the largest error of a pose, max dQint = position error [mm] + angle "
    "[rad], is at most this number.",
    type=POSITIVE,
    metavar="NUMBER",
)

DISTRIBUTION: Any = option(
    "Distribution of the noise of measured values. Uniform noise lies within sqrt(3) = 1.732 "
    "standard deviations: a limit (MPE) of 1 um is --sigma-position 0.57735um.",
    of=_INSTRUMENT,
    type=Words("loopcal.measure.instrument:Distribution"),
)

SIGMA_READING: Any = option(
    "Standard deviation of the recorded actuator readings, for all or each, such as "
    "q1=5um,q2=20urad.  [default: as in the robot file]",
    metavar="QUANTITY",
)


CAMERA = "camera"  # word of --measure for pictures of a printed board


def make_instrument(
    stated: Mapping[str, Any], robot: lc.Mechanism | None = None, **placed: Any
) -> lc.Instrument:
    """Return the instrument of `INSTRUMENT`, and of `UNKNOWN` and the distribution where they are
    stated: fields of the library's `InstrumentDescription`.

    `robot` : gives targets of unknown place an assumed one, and joints their dimension; only needed
    where there are any. `placed` : options of a plan, for the place of a camera.
    """
    from loopcal.apply import simulated_measurements

    described = {key: value for key, value in stated.items() if value is not None}
    board, stations = (described.pop(name, None) for name in ("board", "stations"))
    if described.get("measure") == (CAMERA,) and robot is not None:
        others = (*INSTRUMENT.members, "unknown_frames", "targets")
        sentence = "{reason} takes no {option}. Leave it out, or describe the camera with --like"
        refuse_given(others, "--measure camera", sentence)
        return _place_camera(robot, board, lc.PlanOptions(**placed), stations or 1)
    for name, value in (("--board", board), ("--stations", stations)):
        if value is not None:
            raise DataError(f"{name} belongs to --measure camera. Add it, or leave {name} out")
    if (components := described.pop("measure", None)) is not None:
        if "components" in described or described["kinds"] != ("pose",):
            raise DataError(
                "--measure is short for --kind component --components. Give one or the other"
            )
        described |= {"kinds": ("component",), "components": components}
        if {"phi", "theta", "psi"}.intersection(components):
            described = {"orientation": "tilt-torsion", **described}
    instrument = simulated_measurements.build_instrument(
        simulated_measurements.InstrumentDescription(**described), robot
    )
    _print_assumed_sigma(instrument)
    return instrument if robot is None else simulated_measurements.place_targets(instrument, robot)


def _place_camera(
    robot: lc.Mechanism, file: Path | None, options: lc.PlanOptions, count: int
) -> lc.Instrument:
    """Return a camera at its best stations, and print where these are."""
    from loopcal.io.pictures import choose_board, read_board
    from loopcal.measure.kinds.image import Image
    from loopcal.planning.camera_stations import choose_stations

    if file is None:  # a square is about 1/20 of the robot
        step = 10.0 ** math.floor(math.log10(0.05 * robot.size))
        board = choose_board(10, 7, math.ceil(0.05 * robot.size / step) * step)
    else:
        board = read_board(file)
    measured = replace(board, measured=board.measured or board.marks)
    camera = Image(corners=board.corners, square=board.square)
    with terminal.TerminalProgress() as progress:
        instrument, stations = choose_stations(
            robot, camera, options, measured.scales, progress, count
        )
    for station in stations:
        terminal.print_finding(station.code, **station.data)
    return instrument


def _print_assumed_sigma(instrument: lc.Instrument) -> None:
    """Print a note where one noise is stated, of lengths or angles, and both are measured."""
    from loopcal.measure.instrument import SIGMA
    from loopcal.results.tables import to_quantity

    options = {"sigma_position": (Dimension.LENGTH, "length", "um"),
               "sigma_angle": (Dimension.ANGLE, "angle", "urad")}  # fmt: skip
    assumed = [name for name in options if not is_given(name)]
    measured = {c.dimension for sensor in instrument.sensors for c in sensor.kind.noise_columns}
    if len(assumed) == 1 and measured.issuperset((Dimension.LENGTH, Dimension.ANGLE)):
        dimension, name, unit = options[assumed[0]]
        sigma = to_quantity(SIGMA[dimension], find_unit(unit))
        terminal.print_finding("data.sigma-assumed", quantity=name, sigma=sigma)


def parse_reading_sigma(text: str | None, robot: lc.Mechanism) -> FloatArray | None:
    """Return the standard deviations (a,) [SI] that --sigma-reading states; None without it."""
    import numpy as np

    if text is None:
        return None
    sigma = {a.name: a.sigma or 0.0 for a in robot.actuators}
    dimensions = {a.name: a.dimension for a in robot.actuators}
    for part in text.split(","):
        name, equals, number = part.rpartition("=")
        if equals and name not in sigma:
            raise DataError(
                f"--sigma-reading names {name!r}{suggest_names(name, sigma)}. The actuators of "
                f"{robot.name} are {', '.join(sigma)}"
            )
        for actuator in (name,) if equals else tuple(sigma):
            try:
                dimension = dimensions[actuator]
                sigma[actuator] = parse_quantity(number, dimension, is_difference=True)
            except UnitError as error:
                raise DataError(f"--sigma-reading {number!r} for {actuator}: {error}") from None
            if not 0.0 <= sigma[actuator] < np.inf:
                raise DataError(
                    f"--sigma-reading for {actuator} is {number}. Give a number above zero, or "
                    "zero for exact readings"
                )
    return np.array(list(sigma.values()))


# Constraints of planned poses

_SIGHT = "loopcal.planning.constraints:LineOfSight"


def _make_constraints(stated: Mapping[str, Any]) -> lc.Constraints:
    """Return the constraints of the library from those of `CONSTRAINTS`."""
    margin, measured = stated["stroke_margin"] or (0.0, "position")
    margins = {"stroke_margin" if measured == "position" else "stroke_margin_angle": margin}
    if stated["seen_from"] is None:
        refuse_given(
            ("facing", "cone", "nearest", "farthest"),
            "give the position of the instrument with --seen-from",
            "{option} belongs to a line of sight, {reason}",
        )
        return lc.Constraints(stated["min_margin"], stated["max_tilt"], None, **margins)
    sight = lc.LineOfSight(
        _parse_three(stated["seen_from"], "--seen-from", Dimension.LENGTH),
        _parse_three(stated["facing"], "--facing", None),
        stated["cone"],
        stated["nearest"],
        math.inf if stated["farthest"] is None else stated["farthest"],
    )
    return lc.Constraints(stated["min_margin"], stated["max_tilt"], sight, **margins)


def _parse_three(text: str, option: str, dimension: Dimension | None) -> FloatArray:
    """Return three numbers (3,), with units where they have a dimension."""
    import numpy as np

    words = text.split(",")
    reason = ""
    try:
        numbers = [
            float(word) if dimension is None else parse_quantity(word, dimension) for word in words
        ]
    except (UnitError, ValueError) as error:
        numbers, reason = [], f" ({error})"
    if len(numbers) != 3:
        example = "0,0,1" if dimension is None else "1.5m,-0.8m,1.1m"
        raise DataError(f"{option} is {text!r}{reason}. Give three numbers, such as {example}")
    return np.array(numbers)


CONSTRAINTS: Any = Group(
    _make_constraints,
    min_margin=option(
        "Smallest distance from a singularity, as a share of the median of the workspace.",
        of="loopcal.planning.constraints:Constraints",
        type=SHARE,
    ),
    stroke_margin=option(
        "Distance of all readings from both ends of their strokes, such as 5mm, or 2deg for "
        "rotary actuators.",
        type=GOAL,
    ),
    max_tilt=option("Largest tilt of the platform, such as 20deg.", type=ANGLE),
    seen_from=option(
        "Position of the instrument in the base frame, such as 1.5m,-0.8m,1.1m.", metavar="X,Y,Z"
    ),
    facing=option(
        "With --seen-from: direction of the target in the axes of the platform.",
        default="0,0,1",
        metavar="X,Y,Z",
    ),
    cone=option(
        "With --seen-from: half angle of the cone in which the target is visible.",
        of=_SIGHT,
        type=ANGLE,
    ),
    nearest=option("With --seen-from: smallest distance of the target.", of=_SIGHT, type=LENGTH),
    farthest=option("With --seen-from: largest distance of the target.", type=LENGTH),
)
