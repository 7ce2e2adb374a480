# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from importlib import import_module
from inspect import signature
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.registry import Registry
from loopcal.units import Dimension, find_unit, parse_quantity

if TYPE_CHECKING:
    import numpy as np
    from click.shell_completion import CompletionItem

    from loopcal.diagnose.conventions.convention_check import ConventionCheck
    from loopcal.estimate.options import FitOptions
    from loopcal.measure.instrument import Instrument
    from loopcal.measure.measurements import Measurements
    from loopcal.mechanism.model import Mechanism
    from loopcal.planning.constraints import Constraints
    from loopcal.typing import FloatArray

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Adds an option to the function of a command."""

FILE = click.Path(path_type=Path)


def complete_robot(
    _context: click.Context, _argument: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the shipped robots that begin as a word; files where there is none."""
    from click.shell_completion import CompletionItem

    from loopcal.io.robot.robot_file import list_shipped_robots

    names = [name for name in list_shipped_robots() if name.startswith(incomplete)]
    return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


robot_argument = click.argument("robot", metavar="ROBOT", shell_complete=complete_robot)
verbose_option = click.option(
    "-v", "--verbose", is_flag=True, help="Print all findings and tables, not only the summary."
)


def _check_data(_context: click.Context, _argument: click.Parameter, paths: Any) -> Any:
    """Refuse a YAML file, such as a robot file, in place of measurements."""
    for path in paths if isinstance(paths, tuple) else () if paths is None else (paths,):
        if path.suffix in (".yaml", ".yml"):
            raise DataError(f"{path} is a YAML file; give a measurement file (CSV)")
    return paths


def data_argument(metavar: str, required: bool = True) -> Decorator:
    """Return the argument of measurement files."""
    kind = {"type": FILE, "nargs": -1, "required": required}
    return click.argument("data", metavar=metavar, callback=_check_data, **kind)


def data_option(name: str, help_text: str, **kind: Any) -> Decorator:
    """Return an option that takes a measurement file."""
    return click.option(
        name, type=FILE, metavar="DATA", callback=_check_data, help=help_text, **kind
    )


class Quantity(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """A number with its unit on the command line, such as 0.02mm; its value is in SI."""

    name = "quantity"

    def __init__(self, dimension: Dimension, is_positive: bool = False) -> None:
        self.dimension, self.is_positive = dimension, is_positive

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the SI value, or fail with what is allowed."""
        if isinstance(value, float):
            return value
        try:
            number = parse_quantity(value, self.dimension)
        except UnitError as error:
            self.fail(str(error), param, ctx)
        if self.is_positive and not number > 0.0:
            self.fail(f"{value!r} is not above 0; give a positive number", param, ctx)
        return number

    def format(self, value: float) -> str:
        """Return a number [SI] as text of the command line, in the unit that suits its size."""
        unit = "mm"
        if self.dimension is Dimension.ANGLE:
            unit = "deg" if value > 1e-3 else "urad"
        return f"{value / find_unit(unit).factor_to_si:g}{unit}"


class Count(click.IntRange):
    """A whole number on the command line, up to a limit of `loopcal.io.core.limits`, which is given
    by its name, so that it is only imported when the option is used; without `least`, the command
    itself refuses small ones.
    """

    def __init__(self, limit: str, least: int | None = None) -> None:
        super().__init__(min=least)
        self.limit = limit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number, or fail with what is allowed."""
        from loopcal.io.core import limits

        number, limit = super().convert(value, param, ctx), getattr(limits, self.limit)
        if number > limit.most:
            self.fail(f"the limit is {limit}; give a smaller number.", param, ctx)
        return int(number)


def _import(place: str) -> Any:
    """Return what a place such as `package.module:NAME` names."""
    module, _, name = place.partition(":")
    return attrgetter(name)(import_module(module))


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
        words = _import(self.place)
        if isinstance(words, Registry) and self.property:
            listed = [name for name, entry in words.items() if getattr(entry, self.property)]
        else:
            listed = list(words) if isinstance(words, Registry) else get_args(words)
        return (*self.others, *listed)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the word, the listed one for another name of a registry."""
        if value in self.others:
            return value
        words = _import(self.place)
        if isinstance(words, Registry) and not self.property and value in words:
            return words.resolve(value)
        return super().convert(value, param, ctx)


class LibraryOption(click.Option):
    """An option with the default of the library: of the function, or record of options, at the
    place `of`, that has it under the same name.
    """

    def __init__(self, *arguments: Any, of: str, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.of = of

    def get_default(self, ctx: click.Context, call: bool = True) -> Any:
        """Return the default; for the help (without `call`) as a text."""
        value = signature(_import(self.of)).parameters[self.name or ""].default
        return self.type.format(value) if not call and isinstance(self.type, Quantity) else value


def library_option(*names: str, of: str, **settings: Any) -> Decorator:
    """Return an option with the default of the library, see `LibraryOption`."""
    return click.option(*names, cls=LibraryOption, of=of, **settings)


class PoseShare(click.types.FloatParamType):
    """A share of the poses on the command line, from 0 to below 1."""

    name = "share"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the share, or fail with what is allowed and what was probably meant."""
        from loopcal.apply.calibration_options import describe_wrong_share

        try:
            share = float(value)
        except ValueError:
            allowed = "a share of the poses is a number from 0 to below 1, such as 0.25 for 25 %"
            self.fail(f"{value!r} is no number; {allowed}.", param, ctx)
        if fault := describe_wrong_share(share):
            self.fail(f"it is {fault}.", param, ctx)
        return share


LENGTH = Quantity(Dimension.LENGTH)
ANGLE = Quantity(Dimension.ANGLE)
POSITIVE_LENGTH = Quantity(Dimension.LENGTH, is_positive=True)
POSITIVE_ANGLE = Quantity(Dimension.ANGLE, is_positive=True)


class OptionGroup:
    """Options in the order of their help; decorates a command with all of them."""

    def __init__(self, *options: Decorator) -> None:
        self.options = options

    def __call__(self, command: Callable[..., Any]) -> Callable[..., Any]:
        """Return the command with the options."""
        for option in reversed(self.options):
            command = option(command)
        return command

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of their values in the function of the command."""
        decorated = click.command("group")(self(lambda: None))
        return tuple(option.name or "" for option in decorated.params)

    def take(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return those of the values of a command that belong to these options."""
        return {name: values[name] for name in self.names}


def file_option(*names: str, **kind: Any) -> Decorator:
    """Return an option that takes the path of a file or folder."""
    return click.option(*names, type=FILE, **kind)


def flag_option(*names: str, help: str) -> Decorator:  # noqa: A002
    """Return an option without a value."""
    return click.option(*names, is_flag=True, help=help)


SHIPPED_PROFILES = ("faro", "leica", "spatial-analyzer")
"""Profiles that come with loopcal."""


def profile_option(help_text: str, *, required: bool = False) -> Decorator:
    """Return the option for the profile of an export: a file, or the name of a shipped one."""
    names = ", ".join(SHIPPED_PROFILES)
    return click.option(
        "--profile",
        metavar="FILE|NAME",
        required=required,
        help=f"{help_text} A file (docs/exports.md), or one of {names}.",
    )


decimal_option = click.option(
    "--decimal",
    type=click.Choice(("point", "comma")),
    help="Decimal mark of the export; with comma, semicolons separate columns in place of commas.  "
    "[default: as the profile states]",
)


def force_option(what: str, more: str = "") -> Decorator:
    """Return the option that lets a command replace what exists, and `more`."""
    return flag_option(
        "--force",
        help=f"Replace {what} if {'they exist' if what.endswith('files') else 'it exists'}{more}.",
    )


def seed_option(what: str) -> Decorator:
    """Return the option for the seed of something random."""
    kind = click.IntRange(min=0)
    return click.option("--seed", type=kind, default=1, metavar="N", help=f"Seed of {what}.")


def format_option(ability: str, help_text: str) -> Decorator:
    """Return the option for the format of a file of another program that can be read or written.

    ability : `read` or `write`.
    """
    words = Words("loopcal.io.formats:FORMATS", property=ability)
    return click.option("--format", "format_name", type=words, help=help_text)


def frame_option(names: str = "fitted, base, relative, or the frame of an instrument") -> Decorator:
    """Return the option for the frame in which errors are stated."""
    return click.option(
        "--frame",
        default="fitted",
        metavar="NAME",
        show_default=True,
        help=f"Frame in which errors are stated: {names}. 'fitted' is after the best rigid fit of "
        "the base and platform frames, as far as the measurements do not determine them.",
    )


def _limit_option(name: str, kind: Quantity, quantity: str, example: str) -> Decorator:
    text = f"Largest allowed {quantity} error on poses that were not fitted, such as {example}"
    return click.option(name, type=kind, help=f"{text}; above it the exit code is 2.")


limit_options = OptionGroup(
    _limit_option("--limit-position", POSITIVE_LENGTH, "position", "0.02mm"),
    _limit_option("--limit-angle", POSITIVE_ANGLE, "orientation", "0.01deg"),
)
"""Decorator for limits on the errors."""

data_options = OptionGroup(
    flag_option("--allow-still", help="Accept a target that does not move from pose to pose."),
    flag_option(
        "--allow-outside-stroke", help="Accept readings outside the stroke of their actuator."
    ),
    flag_option(
        "--allow-implausible",
        help="Accept values that fit far better in another unit, order, sign or column.",
    ),
    flag_option(
        "--allow-duplicates", help="Accept rows that repeat another row to the last digit."
    ),
)
"""Decorator for the flags that accept suspicious measurements."""


def name_option(name: str) -> str:
    """Return the option of the running command that has this name in its function."""
    parameters = click.get_current_context().command.params
    return next(option.opts[-1] for option in parameters if option.name == name)


def is_given(name: str) -> bool:
    """Return whether the user stated an option on the command line."""
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def refuse_given(
    names: Iterable[str],
    reason: str,
    sentence: str = "{option} has no effect {reason}; leave it out",
) -> None:
    """Raise DataError for the first of these options that the user stated; the reason is a clause
    of the sentence, such as "because ..." or "with --profile".
    """
    for name in names:
        if is_given(name):
            raise DataError(sentence.format(option=name_option(name), reason=reason))


def open_robot(
    robot: str, outputs: Iterable[Path | None], inputs: Iterable[Path | None], force: bool
) -> Mechanism:
    """Return a robot; refuse outputs that exist, or that are its file or another input."""
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.robot.robot_file import find_robot_file, load_robot

    refuse_outputs(tuple(outputs), (find_robot_file(robot), *inputs), force)
    return load_robot(robot)


def read_checked_measurements(
    paths: Sequence[Path],
    robot: Mechanism,
    *,
    allow_still: bool = False,
    allow_implausible: bool = False,
    **allowed: bool,
) -> Measurements:
    """Read measurement files as `read_measurements`, and check their conventions."""
    from loopcal.diagnose.conventions.convention_check import check_conventions

    data = read_measurements(paths, robot, **allowed)
    check = check_conventions(
        robot, data, allow_still=allow_still, allow_implausible=allow_implausible
    )
    print_convention_note(check, paths)
    return data


def print_convention_note(check: ConventionCheck, paths: Sequence[Path]) -> None:
    """Print a note where a check of these files leaves a doubt."""
    from loopcal.cli import terminal

    if check.finding is not None:
        terminal.print_note(f"{' and '.join(map(str, paths))}: {check.finding}")


def read_fitted_measurements(
    paths: Sequence[Path], robot: Mechanism, options: Mapping[str, Any]
) -> Measurements:
    """Read the poses that a fit would use, by `data_options`; print a note where others are held
    out.
    """
    from loopcal.cli import terminal
    from loopcal.findings import report_finding

    data = read_checked_measurements(paths, robot, **data_options.take(options))
    if count := int(data.is_held_out.sum()):
        terminal.print_note(str(report_finding("data.held-out-not-counted", count=count)))
    return data.fitted


def read_measurements(paths: Sequence[Path], robot: Mechanism, **allowed: bool) -> Measurements:
    """Read measurement files as one set.

    Print a note where a file names another robot, or another file by its absolute path, or contains
    no measured value.
    """
    from loopcal.cli import terminal
    from loopcal.diagnose.conventions.convention_check import explain_outside_strokes
    from loopcal.findings import report_finding
    from loopcal.io.core.csv_table import read_settings
    from loopcal.io.core.yaml_file import list_absolute_references
    from loopcal.io.data.measurement_file import list_unfilled_files, load_measurements

    for path in paths:
        settings = read_settings(path)
        for finding in list_absolute_references(settings):
            terminal.print_note(str(finding))
        stated = str(settings.content.get("robot") or "").strip()
        if stated not in ("", robot.name):
            code = "workflow.robot-of-other-name"
            note = report_finding(code, file=str(path), stated=stated, used=robot.name)
            terminal.print_note(str(note))
    try:
        with terminal.ProgressBar() as progress:
            progress(0, 1, "reading the measurements")
            data = load_measurements(paths, robot, **allowed)
            unfilled = list_unfilled_files(paths, data)
    except DataError as error:
        if error.finding is not None and error.finding.code == "data.outside-stroke":
            accepted = load_measurements(paths, robot, **{**allowed, "allow_outside_stroke": True})
            explained = explain_outside_strokes(robot, accepted, error.finding.data)
            if explained is not None:
                text = f"{' and '.join(map(str, paths))}: {explained}"
                raise DataError(text) from DataError(explained)
        raise
    for file in unfilled:
        terminal.print_note(str(report_finding("files.no-measured-value", file=str(file))))
    return data


FIT = "loopcal.estimate.options:FitOptions"

rank_tolerance_option = library_option(
    "--rank-tolerance",
    of=FIT,
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    metavar="SHARE",
    help="Share of the largest singular value below which one counts as zero.",
)
"""Decorator of a command that decides a rank."""

fit_options = OptionGroup(
    click.option(
        "--method",
        type=Words("loopcal.estimate.methods:METHODS"),
        default="auto",
        help="map: the tolerances are a prior. auto: map, with tolerances inflated where the "
        "data contradict them. least-squares (or ls): without tolerances. ridge, truncated-svd "
        "(or tsvd): regularized least squares.",
    ),
    click.option(
        "--inflation",
        type=Words("loopcal.estimate.tolerance_components:By", "none"),
        help="For auto: which tolerances may be inflated. global: all by one factor. groups: also "
        "limbs and types of parameters, and what these have in common. heavy-tailed: also single "
        "parameters. auto, the default: all of these. none: as stated.",
    ),
    click.option(
        "--lam",
        type=click.FloatRange(min=0),
        metavar="WEIGHT",
        help="For ridge: weight of the penalty; by default chosen by cross-validation.",
    ),
    click.option(
        "--keep",
        type=click.IntRange(min=0),
        metavar="K",
        help="For truncated-svd: number of directions; by default chosen by cross-validation.",
    ),
    library_option(
        "--noise",
        of=FIT,
        type=Words("loopcal.estimate.options:Noise"),
        help="Take the stated sigmas as true, or as true up to one common factor that is "
        "estimated.",
    ),
    library_option(
        "--sigma-uncertainty",
        of=FIT,
        type=click.FloatRange(0, 1),
        metavar="SHARE",
        help="Relative standard uncertainty of given sigmas, which the intervals account for; 0 "
        "takes them as exact.",
    ),
    click.option(
        "--loss",
        type=Words("loopcal.estimate.losses:LOSSES", "none"),
        default="none",
        help="Reduce the weight of poses that are far from the fit.",
    ),
    rank_tolerance_option,
    click.option(
        "--drop",
        "excluded_poses",
        multiple=True,
        metavar="POSE",
        help="Exclude this pose from fit and validation. May be given several times.",
    ),
)
"""Decorator of a command that fits; `make_fit_options` takes their values."""


def make_fit_options(options: Mapping[str, Any]) -> FitOptions:
    """Return the options of the library from those of `fit_options`."""
    from loopcal.estimate.options import FitOptions, find_foreign_setting

    stated = fit_options.take(options)
    if (foreign := find_foreign_setting(stated)) is not None:
        raise DataError(
            f"--{foreign[0]} belongs to --method {foreign[1]}, not to {stated['method']}; leave it "
            "out, or change the method"
        )
    return FitOptions.from_dict(stated)


INSTRUMENT = "loopcal.apply.simulated_measurements:InstrumentDescription"

instrument_options = OptionGroup(
    click.option(
        "--kind",
        default="pose",
        help="Kind of measurement: pose, component, position, bearing, ...; or several, such "
        "as position,inclination.",
    ),
    click.option(
        "--components",
        metavar="NAMES",
        help="Coordinates that the kind 'component' measures, such as z or x,y,z.",
    ),
    click.option(
        "--orientation",
        metavar="FORM",
        help="Form of measured angles: rotation-vector, quaternion, tilt-torsion, euler-xyz, ...",
    ),
    library_option(
        "--sigma-position",
        of=INSTRUMENT,
        type=POSITIVE_LENGTH,
        help="Standard deviation of each measured length.",
    ),
    library_option(
        "--sigma-angle",
        of=INSTRUMENT,
        type=POSITIVE_ANGLE,
        help="Standard deviation of each measured angle.",
    ),
)
"""Decorator for the kind of measurement and its noise; `make_instrument` takes their values."""

unknown_options = OptionGroup(
    click.option(
        "--measure",
        metavar="NAMES",
        help="Short for --kind component --components NAMES: some of x,y,z,phi,theta,psi.",
    ),
    click.option(
        "--frames",
        metavar="NAMES",
        help="Unknown frames: base (the frame of the instrument in the base), tool, or base,tool.",
    ),
    click.option(
        "--targets",
        metavar="NAMES",
        help="Targets at unknown places on the platform, of a kind such as position: "
        "SMR1,SMR2,SMR3.",
    ),
)
"""Decorator for the short form of components, and for unknown frames and targets."""

draw_option = click.option(
    "--draw",
    type=Count("DRAWN_POSES", 1),
    default=40,
    metavar="N",
    help="Number of poses to draw evenly from the workspace where no poses are given.",
)

distribution_option = library_option(
    "--distribution",
    of=INSTRUMENT,
    type=Words("loopcal.measure.instrument:Distribution"),
    help="Distribution of the noise of measured values. Uniform noise lies within sqrt(3) = 1.732 "
    "standard deviations; a limit of 1 um is --sigma-position 0.57735um.",
)
"""Decorator of a command that simulates noise."""

sigma_reading_option = click.option(
    "--sigma-reading",
    metavar="QUANTITY",
    help="Standard deviation of the recorded actuator readings, for all or each, such as "
    "q1=5um,q2=20urad.  [default: as in the robot file]",
)


def make_instrument(options: Mapping[str, Any], robot: Mechanism | None = None) -> Instrument:
    """Return the instrument of `instrument_options`, and of `unknown_options` if there are any.

    `robot` : gives targets of unknown place an assumed one; only needed where there are targets.
    """
    from loopcal.apply.simulated_measurements import (
        InstrumentDescription,
        build_instrument,
        place_targets,
    )

    kind, components = options["kind"], options["components"]
    orientation, measure = options["orientation"], options.get("measure")
    if measure is not None:
        if components is not None or kind != "pose":
            raise DataError(
                "--measure is short for --kind component --components; give one or the other"
            )
        kind, components = "component", measure
        if orientation is None and {"phi", "theta", "psi"} & set(measure.split(",")):
            orientation = "tilt-torsion"
    frames, targets = options.get("frames"), options.get("targets")
    instrument = build_instrument(
        InstrumentDescription(
            kinds=tuple(kind.split(",")),
            components=tuple(components.split(",")) if components else (),
            orientation=orientation,
            sigma_position=options["sigma_position"],
            sigma_angle=options["sigma_angle"],
            unknown_frames=tuple(frames.split(",")) if frames is not None else (),
            targets=tuple(targets.split(",")) if targets is not None else (),
            distribution=options.get("distribution", "normal"),
        )
    )
    return instrument if robot is None else place_targets(instrument, robot)


def parse_reading_sigma(text: str | None, robot: Mechanism) -> np.ndarray | None:
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
                f"--sigma-reading names {name!r}{suggest_names(name, sigma)}; the actuators of "
                f"{robot.name} are {', '.join(sigma)}"
            )
        for actuator in (name,) if equals else tuple(sigma):
            try:
                sigma[actuator] = parse_quantity(number, dimensions[actuator])
            except UnitError as error:
                raise DataError(f"--sigma-reading {number!r} for {actuator}: {error}") from None
            if not 0.0 <= sigma[actuator] < np.inf:
                raise DataError(
                    f"--sigma-reading for {actuator} is {number}; give a number above zero, or "
                    "zero for exact readings"
                )
    return np.array(list(sigma.values()))


class Goal(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """A length or an angle with its unit: of positions ("position") or of orientations."""

    name = "quantity"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, str]:
        """Return the SI value and the quantity it limits, or fail with what is allowed."""
        if isinstance(value, tuple):
            return value
        with suppress(UnitError):
            return parse_quantity(value, Dimension.ANGLE), "orientation"
        try:
            return parse_quantity(value, Dimension.LENGTH), "position"
        except UnitError as error:
            self.fail(f"{error}; or give an angle, such as 10urad", param, ctx)


constraint_options = OptionGroup(
    library_option(
        "--min-margin",
        of="loopcal.planning.constraints:Constraints",
        type=float,
        help="Smallest distance from a singularity, as a share of the median of the workspace.",
    ),
    click.option(
        "--stroke-margin",
        type=Goal(),
        help="Distance of all readings from both ends of their strokes, such as 5mm; 2deg for "
        "actuators that turn.",
    ),
    click.option("--max-tilt", type=ANGLE, help="Largest tilt of the platform, such as 20deg."),
    click.option(
        "--seen-from",
        metavar="X,Y,Z",
        help="Position of the instrument in the base frame, such as 1.5m,-0.8m,1.1m.",
    ),
    click.option(
        "--facing",
        default="0,0,1",
        metavar="X,Y,Z",
        help="With --seen-from: direction of the target in the axes of the platform.",
    ),
    library_option(
        "--cone",
        of="loopcal.planning.constraints:LineOfSight",
        type=ANGLE,
        help="With --seen-from: half angle of the cone in which the target is visible.",
    ),
    library_option(
        "--nearest",
        of="loopcal.planning.constraints:LineOfSight",
        type=LENGTH,
        help="With --seen-from: smallest distance of the target.",
    ),
    click.option(
        "--farthest", type=LENGTH, help="With --seen-from: largest distance of the target."
    ),
)
"""Decorator of a command that plans; `make_constraints` takes their values."""


def make_constraints(options: Mapping[str, Any]) -> Constraints:
    """Return the constraints of the library from those of `constraint_options`."""
    from loopcal.planning.constraints import Constraints, LineOfSight

    margin, measured = options["stroke_margin"] or (0.0, "position")
    margins = {"stroke_margin" if measured == "position" else "stroke_margin_angle": margin}
    if options["seen_from"] is None:
        refuse_given(
            ("facing", "cone", "nearest", "farthest"),
            "state the position of the instrument with --seen-from",
            "{option} belongs to a line of sight; {reason}",
        )
        return Constraints(options["min_margin"], options["max_tilt"], None, **margins)
    sight = LineOfSight(
        _parse_three(options["seen_from"], "--seen-from", Dimension.LENGTH),
        _parse_three(options["facing"], "--facing", None),
        options["cone"],
        options["nearest"],
        math.inf if options["farthest"] is None else options["farthest"],
    )
    return Constraints(options["min_margin"], options["max_tilt"], sight, **margins)


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
        raise DataError(f"{option} is {text!r}{reason}; give three numbers, such as {example}")
    return np.array(numbers)
