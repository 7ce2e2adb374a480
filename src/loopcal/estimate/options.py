# SPDX-License-Identifier: Apache-2.0
"""The options of a fit, as one value that `identify`, `identify_trials` and `recalibrate` share.

As plain data (`FitOptions.to_dict`, `from_dict`) they have one vocabulary on the command line, in
study files and in the results of runs. A method, loss or rule is its name in its registry, or
`{name: ridge, lam: 2.0}` with settings other than the default ones.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal

import numpy as np

from loopcal.checks import Limit, Limited
from loopcal.errors import DataError, EstimationError, suggest_names
from loopcal.estimate.descent import StepControl
from loopcal.estimate.losses import LOSSES, Loss
from loopcal.estimate.methods import METHODS, RULES, SETTINGS
from loopcal.estimate.penalties import Method
from loopcal.estimate.prior import Prior
from loopcal.estimate.residual_test import SIGMA_UNCERTAINTY
from loopcal.measure.array_checks import check_type
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.numerics.decomposition import RANK_TOLERANCE
from loopcal.plain_text import list_changes, represent
from loopcal.registry import Registry
from loopcal.typing import FloatArray

Noise = Literal["given", "estimated"]
"""Whether the stated sigmas are true, or true up to one common factor."""

Begin = Literal["kinematics", "closure"]
"""What is linearized first: the predicted poses, or the loop closure at the measured poses."""

# Attributes that make an object a method, see `loopcal.estimate.penalties.Method`.
METHOD_PARTS = ("required_equations", "unpenalized", "root", "penalty")


def _instances(attributes: Sequence[str], examples: str) -> Limit:
    """Return the limit of objects that are no class and have these attributes."""
    return Limit(
        lambda x: not isinstance(x, type) and all(hasattr(x, name) for name in attributes),
        f"an instance such as {examples}",
        repr,
    )


@dataclass(frozen=True, eq=False)
class FitOptions(Limited):
    """Options of a fit. Every field has a default; `FitOptions()` is what `identify` uses.

    Parameters
    ----------
    method : how directions that the data hardly determine are treated. None is the default:
        `MAP(InflatedTolerances())`, or least squares where there is a `prior`.
    loss : `Huber()` or `Tukey()` reduce the weight of observation blocks far from the fit; None
        gives all rows their full weight.
    noise : "given" takes the sigmas of the data as true, "estimated" up to one common factor.
    sigma_uncertainty : relative standard uncertainty of given sigmas. The residuals correct them
        within it, and intervals account for it; 0 takes them as exact.
    prior : an earlier calibration, see `loopcal.estimate.prior.prior_from`.
    start : (p of the robot,) or (t, p of the robot) [SI] values to begin with; None begins with the
        values of the robot.
    begin : "closure" first linearizes the loop closure at the measured poses, for starts far off.
        It needs poses that are measured in full.
    control : settings of the iteration.
    rank_tolerance : singular values below this share of the largest one count as zero.
    allow_fewer_equations : lets least squares return the smallest deviation from nominal that
        explains fewer equations than there are parameters.
    excluded_poses : labels of poses that get weight 0.
    nuisance : unknown frames, targets, surfaces and offsets of the measurements, with priors or
        fixed values; None frees all of them.

    Raises
    ------
    EstimationError : a value that is not allowed, with the allowed ones.

    Examples
    --------
    >>> FitOptions(noise="estimated", excluded_poses=("6",))
    FitOptions(noise='estimated', excluded_poses=('6',))
    """

    method: Method | None = None
    loss: Loss | None = None
    noise: Noise = "given"
    sigma_uncertainty: float = SIGMA_UNCERTAINTY
    prior: Prior | None = None
    start: Sequence[float] | FloatArray | None = None
    begin: Begin = "kinematics"
    control: StepControl = field(default_factory=StepControl)
    rank_tolerance: float = RANK_TOLERANCE
    allow_fewer_equations: bool = False
    excluded_poses: Sequence[str] = ()
    nuisance: NuisanceParameters | None = None

    ERROR: ClassVar[type[Exception]] = EstimationError
    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "sigma_uncertainty": Limit(
            lambda value: 0.0 <= value <= 1.0, "from 0 (the given sigmas are exact) to 1"
        ),
        "method": _instances(METHOD_PARTS, "MAP(), LeastSquares(), Ridge(1.0) or TruncatedSVD(10)"),
        "loss": _instances(("weight",), "Huber() or Tukey()"),
        "rank_tolerance": Limit(lambda value: 0.0 < value < 1.0, "above 0 and below 1"),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.prior is not None:
            check_type(self.prior, Prior, "prior", "as from prior_from(fit.posterior)")
        check_type(self.control, StepControl, "control", "such as StepControl(iterations=100)")
        if self.nuisance is not None:
            wanted = "such as measurements.nuisance_parameters"
            check_type(self.nuisance, NuisanceParameters, "nuisance", wanted)
        object.__setattr__(
            self, "excluded_poses", check_labels("excluded_poses", self.excluded_poses)
        )
        if self.start is not None:
            start = np.array(self.start, dtype=np.float64)
            start.setflags(write=False)
            object.__setattr__(self, "start", start)

    __repr__ = represent

    def to_dict(self) -> dict[str, Any]:
        """Return the options as plain data, which `from_dict` reads.

        An object without a name in a registry is `{object: text}`, which cannot be read back.
        """
        plain = {entry.name: _to_plain(getattr(self, entry.name)) for entry in fields(self)}
        plain["method"] = "auto" if self.method is None else _name_entry(METHODS, self.method)
        plain["loss"] = NO_LOSS if self.loss is None else _name_entry(LOSSES, self.loss)
        plain["control"] = _list_settings(self.control)
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> FitOptions:
        """Return options from plain data.

        Parameters
        ----------
        plain : some of the fields by name; those that are left out have their defaults. Settings of
            the method may stand beside it, see `loopcal.estimate.methods.SETTINGS`; None stands for
            a setting that nobody stated.

        Raises
        ------
        DataError : an unknown key, name or setting, or an object that has no name.
        EstimationError : a value that is not allowed.
        """
        beside = {key: plain[key] for key in SETTINGS if plain.get(key) is not None}
        given = {key: value for key, value in plain.items() if key not in SETTINGS}
        _refuse_unknown(given, cls, "not an option of a fit")
        for key in ("prior", "nuisance"):
            if given.get(key) is not None:
                _refuse_object(given[key])
        method, loss = given.pop("method", "auto"), given.pop("loss", NO_LOSS)
        if beside:
            method = {"name": method} if isinstance(method, str) else dict(method)
            method |= {SETTINGS[key][1]: value for key, value in beside.items()}
        control = given.pop("control", None) or {}
        _refuse_unknown(control, StepControl, "no limit of the steps")
        given = {key: _from_plain(value) for key, value in given.items()}
        return cls(
            method=_make_entry(METHODS, method),
            loss=None if loss == NO_LOSS else _make_entry(LOSSES, loss),
            control=StepControl(**control),
            **given,
        )


def find_foreign_setting(plain: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the first setting that stands beside the name of a method it does not belong to, with
    the method that it belongs to; None where there is none.
    """
    method = plain.get("method", "auto")
    method = METHODS.resolve(method if isinstance(method, str) else method.get("name", "auto"))
    for key, (owner, _) in SETTINGS.items():
        if plain.get(key) is not None and method != owner:
            return key, owner
    return None


NO_LOSS = "none"  # name of the loss None
OBJECT = "object"  # key of the text of an object that has no name


def _refuse_unknown(given: Iterable[str], of_class: type[Any], what: str) -> None:
    """Refuse keys that are no fields of a class."""
    known = [entry.name for entry in fields(of_class)]
    for key in given:
        if key not in known:
            raise DataError(f"{key!r} is {what}{suggest_names(key, known)}")


def _to_plain(value: Any) -> Any:
    """Return a value of an option as plain data."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, tuple | list):
        return [_to_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _to_plain(item) for key, item in value.items()}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return _name_entry(RULES, value) if callable(value) else {OBJECT: repr(value)}


def _name_entry(registry: Registry[Any], value: Any) -> Any:
    """Return an instance of a registered class as its name, or as a mapping with its settings."""
    name = getattr(type(value), "name", "")
    is_plain = dataclasses.is_dataclass(value) or not vars(value)
    if name not in registry or registry[name] is not type(value) or not is_plain:
        return {OBJECT: repr(value)}
    settings = _list_settings(value)
    named = {"name": name, **settings}
    # a rule inside a method is a mapping always, to be told from a word
    return name if not settings and registry is not RULES else named


def _list_settings(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that differ from their defaults, as plain data."""
    if not dataclasses.is_dataclass(value):
        return {}
    return {name: _to_plain(content) for name, content in list_changes(value).items()}


def _from_plain(value: Any) -> Any:
    """Return the value of an option from plain data."""
    if isinstance(value, Mapping) and ("name" in value or OBJECT in value):
        return _make_entry(RULES, value)
    return tuple(_from_plain(item) for item in value) if isinstance(value, list) else value


def _make_entry(registry: Registry[Any], plain: str | Mapping[str, Any]) -> Any:
    """Return the instance that a name, or a mapping with a name and settings, stands for."""
    stated = {"name": plain} if isinstance(plain, str) else dict(plain)
    _refuse_object(stated)
    name = stated.pop("name", None)
    if not isinstance(name, str):
        raise DataError(f"{plain!r} names no {registry.noun}. Known: {', '.join(registry)}")
    make = registry[name]
    allowed = inspect.signature(make).parameters
    for key in stated:
        if key not in allowed:
            has = ", ".join(allowed) or "none"
            raise DataError(f"the {registry.noun} {name} has no setting {key!r}; it has {has}")
    return make(**{key: _from_plain(value) for key, value in stated.items()})


def _refuse_object(plain: Any) -> None:
    """Raise DataError for the text of an object that has no name."""
    if isinstance(plain, Mapping) and OBJECT in plain:
        raise DataError(
            f"{plain[OBJECT]} has no registered name. Register its class (docs/extending.md)"
        )


def merge_options(
    options: FitOptions | None, method: Method | None = None, loss: Loss | None = None
) -> FitOptions:
    """Return options in which a method and a loss that are not None replace those of `options`."""
    if options is None:
        return FitOptions(method=method, loss=loss)
    shortcuts = {"method": method, "loss": loss}
    stated = {name: value for name, value in shortcuts.items() if value is not None}
    return dataclasses.replace(options, **stated) if stated else options


def check_labels(option: str, labels: Sequence[str]) -> tuple[str, ...]:
    """Return labels of poses as a tuple; raise DataError for a single text."""
    if isinstance(labels, str):
        raise DataError(
            f"{option} is the text {labels!r}. Give a sequence of labels, such as [{labels!r}]"
        )
    given = tuple(labels)
    for label in given:
        check_type(label, str, option, f"the label of a pose, such as '{label}'")
    return given
