# SPDX-License-Identifier: Apache-2.0
"""The unknowns that measurements bring with them: which there are, what they are called, and which
row uses which.

A kind states its unknowns once, each with a scope; here every session and every group gets a set of
its own. A name is `tracker.x`, or `monday.tracker.x` where the session is called monday; kinds that
use the same name share the unknown.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError, suggest_names
from loopcal.measure.kinds import Kind
from loopcal.parameters import Parameter, ParameterTable
from loopcal.typing import FloatArray

Ints = NDArray[np.intp]
Texts = NDArray[np.str_]


class Labelled(Protocol):
    """Rows of a kind, whether measured or still to be simulated."""

    @property
    def kind(self) -> Kind:
        """The kind."""
        ...

    @property
    def rows(self) -> Ints:
        """(r,) or (r, l) poses."""
        ...

    @property
    def session(self) -> Texts:
        """(r,) sessions."""
        ...

    @property
    def group(self) -> Texts:
        """(r,) groups."""
        ...


@dataclass(frozen=True)
class StatedValue:
    """What is known beforehand of one unknown that measurements bring with them.

    Parameters
    ----------
    name : str
        Its full name, such as `monday.tracker.x`.
    sd : float
        Standard deviation of a prior [SI]; 0 keeps the unknown fixed.
    nominal : float, optional
        The value that it is kept at, or that the prior is about [SI]; default that of its kind.

    Raises
    ------
    DataError
        If the standard deviation is negative or not finite.
    """

    name: str
    sd: float = 0.0
    nominal: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.sd < float("inf"):
            raise DataError(
                f"the standard deviation of {self.name!r} is {self.sd}; give a number above 0, or "
                "0 to fix the unknown"
            )

    def applied(self, entry: Parameter) -> Parameter:
        """The unknown with what is known of it."""
        nominal = entry.nominal if self.nominal is None else self.nominal
        return replace(
            entry,
            nominal=nominal,
            tolerance=self.sd or entry.tolerance,
            free=entry.free and self.sd > 0.0,
        )


@dataclass(frozen=True, eq=False)
class NuisanceParameters:
    """All unknowns that measurements bring with them.

    Attributes
    ----------
    table : ParameterTable
        The U unknowns. A tolerance is a prior; None leaves the unknown to the data alone; fixed
        ones keep their value.
    indices : tuple of (r, u) int
        For each kind of the measurements, which unknowns its rows use.
    """

    table: ParameterTable
    indices: tuple[Ints, ...]

    def __len__(self) -> int:
        return len(self.table)

    def select(self, kind: int, values: FloatArray) -> FloatArray:
        """Values (t, r, u) for the rows of one kind, from those of all unknowns (t, U)."""
        return values[:, self.indices[kind]]

    def values(self, known: Mapping[str, float] | None = None) -> FloatArray:
        """Values (U,): nominal, or as known by name; DataError for a name that is not there."""
        found = np.array(self.table.nominal)
        for name, value in (known or {}).items():
            found[self._index(name)] = value
        return found

    def matching(self, known: Mapping[str, float]) -> FloatArray:
        """Values (U,): those known by name where they occur here, else nominal."""
        return self.values(
            {name: value for name, value in known.items() if name in self.table.names}
        )

    def with_prior(self, pattern: str, sd: float) -> Self:
        """The same, with a prior of this standard deviation [SI] on unknowns such as `tracker.*`."""
        if not sd > 0.0:
            raise DataError(
                f"the standard deviation of {pattern!r} is {sd}; give a number above 0, or fix the "
                "unknown"
            )
        return self._changed(pattern, tolerance=sd)

    def with_fixed(self, pattern: str) -> Self:
        """The same, with unknowns such as `tracker.r?` kept at their nominal values."""
        return self._changed(pattern, free=False)

    def with_nominal(self, values: FloatArray) -> Self:
        """The same, with other nominal values (U,)."""
        pairs = zip(self.table.entries, np.asarray(values).tolist(), strict=True)
        return replace(
            self, table=ParameterTable(tuple(replace(p, nominal=value) for p, value in pairs))
        )

    def _changed(self, pattern: str, **change: float | bool) -> Self:
        hit = [fnmatchcase(name, pattern) for name in self.table.names]
        if not any(hit):
            self._index(pattern)
        entries = zip(self.table.entries, hit, strict=True)
        return replace(
            self, table=ParameterTable(tuple(replace(p, **change) if h else p for p, h in entries))
        )

    def _index(self, name: str) -> int:
        if name not in self.table.names:
            known = ", ".join(self.table.names[:12]) or "none"
            raise DataError(
                "no unknown of these measurements is called "
                f"{name!r}{suggest_names(name, self.table.names)}; there are {known}"
            )
        return self.table.index(name)


def collect_nuisance_parameters(
    observations: Iterable[Labelled], labels: tuple[str, ...], known: Iterable[StatedValue] = ()
) -> NuisanceParameters:
    """Gather the unknowns of measurements.

    Parameters
    ----------
    observations : of `Measurements`, or anything with kind, rows, session and group.
    labels : names of the poses.
    known : what is known of some of them, usually `Measurements.stated_values`; of names that do not occur
        nothing is said.

    Returns
    -------
    NuisanceParameters

    Raises
    ------
    DataError
        If two kinds share the name of an unknown and state it differently.
    """
    entries: dict[str, Parameter] = {}
    references: dict[str, FloatArray] = {}
    places = []
    for rows in observations:
        kind = rows.kind
        _agree(references, kind)
        owners = {
            scope: _owners(rows, scope, labels)
            for scope in {p.scope for p in kind.nuisance_parameters}
        }
        twice = [p.name for p in kind.nuisance_parameters]
        if len(set(twice)) < len(twice):
            again = next(name for name in twice if twice.count(name) > 1)
            raise DataError(
                f"the kind {kind.name!r} calls two unknowns {again!r}; give frames, targets and "
                "surfaces different names"
            )
        keys = list(zip(*owners.values(), strict=True)) if owners else [()] * len(rows.rows)
        own = {
            key: _entered_all(entries, kind, dict(zip(owners, key, strict=True)))
            for key in dict.fromkeys(keys)
        }
        order = {name: i for i, name in enumerate(entries)}
        used = {key: [order[name] for name in names] for key, names in own.items()}
        places.append(
            np.array([used[key] for key in keys], dtype=np.intp).reshape(
                len(rows.rows), len(kind.nuisance_parameters)
            )
        )
    for said in known:
        if said.name in entries:
            entries[said.name] = said.applied(entries[said.name])
    return NuisanceParameters(ParameterTable(tuple(entries.values())), tuple(places))


def _owners(rows: Labelled, scope: str, labels: tuple[str, ...]) -> list[str]:
    """Who owns an unknown of this scope, row by row."""
    if scope == "session":
        return rows.session.tolist()
    if scope == "group":
        # a group is one of its session, unless there is only one session
        pairs = zip(rows.session.tolist(), rows.group.tolist(), strict=True)
        return [".".join(part for part in pair if part) for pair in pairs]
    if scope == "pose":
        return [labels[int(i)] for i in rows.rows.reshape(len(rows.rows), -1)[:, 0]]
    return [""] * len(rows.rows)


def _entered_all(entries: dict[str, Parameter], kind: Kind, owner: Mapping[str, str]) -> list[str]:
    """Enter all unknowns of a kind for the owners of each scope; their full names."""
    return [
        _entered(entries, parameter, owner[parameter.scope], kind)
        for parameter in kind.nuisance_parameters
    ]


def _entered(entries: dict[str, Parameter], parameter: Parameter, owner: str, kind: Kind) -> str:
    """Enter an unknown under its full name, unless it is there; refuse another one of the same
    name.
    """
    name = f"{owner}.{parameter.name}" if owner else parameter.name
    entry = replace(parameter, name=name)
    there = entries.setdefault(name, entry)
    if there != entry:
        raise DataError(
            f"the kind {kind.name!r} states the unknown {name!r} as {entry.nominal:.9g} (scope "
            f"{entry.scope}), another one as"
            f" {there.nominal:.9g} (scope {there.scope}); state it alike, or give it another name"
        )
    return name


def _agree(references: dict[str, FloatArray], kind: Kind) -> None:
    for name, value in kind.references.items():
        if not np.array_equal(references.setdefault(name, value), value):
            raise DataError(
                f"the kind {kind.name!r} counts the unknowns of {name!r} from another orientation "
                "or place than the kind"
                " before; state them alike, or give one another name"
            )
