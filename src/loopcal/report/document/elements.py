# SPDX-License-Identifier: Apache-2.0
"""What a document consists of: sections with sentences, lists, tables, pictures and lines of code.

A sentence is a `str`; a table is the one that the terminal shows, too.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopcal.apply.calibration_report import Verdict
from loopcal.apply.height_errors import HeightErrors
from loopcal.apply.validation import Validation
from loopcal.estimate.options import OBJECT, FitOptions
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.result import KindResiduals
from loopcal.findings import Quantity
from loopcal.mechanism.model import Mechanism
from loopcal.plain_text import escape
from loopcal.report.scene.scene import load_script
from loopcal.results.description import Field, fields
from loopcal.results.tables import Table

if TYPE_CHECKING:
    from jinja2 import Template


@dataclass(frozen=True)
class Picture:
    """A figure as SVG elements for HTML.

    name : prefix of its identifiers. svg : see `inline_figure`. caption : shown below it.
    description : what it shows, for readers who do not see it.
    scene : JSON of a scene, which replaces the figure where a browser has WebGL; empty without.
    """

    name: str
    svg: str = field(repr=False)
    caption: str
    description: str
    scene: str = field(default="", repr=False)

    @property
    def is_narrow(self) -> bool:
        """Whether it is little wider than high, so that two stand side by side on paper."""
        box = re.search(r'viewBox="0 0 (\S+) (\S+)"', self.svg)
        return box is not None and float(box[1]) < 1.3 * float(box[2])


@dataclass(frozen=True)
class Listing:
    """Labels with sentences, such as the severity and text of findings."""

    items: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Code:
    """Lines to copy, such as those of a controller's file, with a title."""

    title: str
    text: str


@dataclass(frozen=True)
class Form:
    """Facts by the words that people read; an empty one is a line to fill in on paper."""

    rows: tuple[tuple[str, str], ...]


Element = str | Table | Picture | Listing | Code | Form


@dataclass(frozen=True)
class Section:
    """A heading with its content.

    name : identifier, to link to it. elements : the content in order; without any the section is
        left out.
    """

    name: str
    title: str
    elements: tuple[Element, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        "name", "title", elements=lambda section: [_describe(e) for e in section.elements]
    )


@dataclass(frozen=True)
class Document:
    """Sections below a title.

    verdict : name of the verdict, such as `not_calibrated`, which decides the color of the head;
        empty without a verdict.
    summary : the one sentence below the title. made_by : program and version.
    """

    title: str
    verdict: str
    summary: str
    made_by: str
    sections: tuple[Section, ...]


def _describe(element: Element) -> dict[str, Any]:
    """Return an element for JSON, under the word that says what it is."""
    if isinstance(element, str):
        return {"sentence": element}
    if isinstance(element, Table):
        columns = [column.heading for column in element.columns]
        return {"table": element.caption, "columns": columns, "rows": element.rows}
    if isinstance(element, Picture):
        return {"picture": element.caption, "description": element.description}
    if isinstance(element, Listing):
        return {"list": [{"label": label, "text": text} for label, text in element.items]}
    if isinstance(element, Form):
        return {"form": dict(element.rows)}
    return {"code": element.title, "text": element.text}


# A document as one HTML file, which loads nothing.

TEMPLATE, STYLE = "report.html.j2", "report.css"
FOLDER = Path(__file__).parent
WIDEST = 6  # columns from which a table is set in a smaller font


SHORTEST = 16  # rows up to which a table stays on one page of paper


def render_html(document: Document) -> str:
    """Return a document as HTML; a name that is not plain text is shown with escapes."""
    style = (FOLDER / STYLE).read_text("utf-8")
    elements = (element for section in document.sections for element in section.elements)
    has_scene = any(isinstance(element, Picture) and element.scene for element in elements)
    script = load_script() if has_scene else ""
    allowed = f"script-src '{_digest(script)}'; " if script else ""
    policy = f"default-src 'none'; {allowed}style-src '{_digest(style)}'; img-src data:"
    return _load_template().render(
        document=document,
        style=style,
        script=script,
        policy=f"{policy}; base-uri 'none'; form-action 'none'",
        widest=WIDEST,
        shortest=SHORTEST,
    )


def _digest(text: str) -> str:
    """Return the source of a content security policy that allows exactly this text."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


@cache
def _load_template() -> Template:
    """Return the template, whose text is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def show(value: Any) -> Any:
        is_text = isinstance(value, str) and not isinstance(value, Markup)
        return escape(value, "\n") if is_text else value

    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        finalize=show,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE)


# What the report of a calibration shows: the content of a run, as numbers and objects.


@dataclass(frozen=True)
class ControllerValues:
    """Identified values as a controller reads them.

    format : name of the format. what : a line about it. text : of the file. notes : what it cannot
        express, and what it changes.
    """

    format: str
    what: str
    text: str = field(repr=False)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CalibrationRecord:
    """Content of a run.

    result : content of result.json, with numbers that are not finite.
    arrays : content of arrays.npz [SI].
    robot : the corrected robot, of which the identified parameters are free. initial : the robot
        before the calibration.
    posterior : estimates and their uncertainty.
    validation : errors at held-out poses; None without any.
    heights : errors of measured heights; None without any.
    residuals : of every kind.
    controllers : the values for controllers that can store them.
    facts : what people state beside the results, such as the customer, by the words for it.
    """

    result: Mapping[str, Any] = field(repr=False)
    arrays: Mapping[str, np.ndarray] = field(repr=False)
    robot: Mechanism
    initial: Mechanism
    posterior: Posterior
    validation: Validation | None
    heights: HeightErrors | None
    residuals: tuple[KindResiduals, ...]
    controllers: tuple[ControllerValues, ...]
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        """The verdict."""
        return Verdict[str(self.result["verdict"]).upper()]

    @property
    def converged(self) -> bool:
        """Whether the fit converged."""
        return self.result["fit"]["status"] == "converged"

    @property
    def findings(self) -> tuple[Mapping[str, Any], ...]:
        """The findings, the most important first."""
        return tuple(self.result.get("findings") or ())

    @property
    def fitted_labels(self) -> tuple[str, ...]:
        """Labels of fitted poses, without those excluded by options."""
        excluded = self.result["fit"]["dropped"]
        return tuple(n for n in self.arrays["poses"].tolist() if n not in excluded)

    @property
    def held_out_labels(self) -> tuple[str, ...]:
        """Labels of the held-out poses."""
        return tuple((self.result.get("split") or {}).get("held_out", ()))

    @property
    def readings(self) -> np.ndarray | None:
        """(n, a) readings of the fitted poses; None where the run does not contain them."""
        return self.arrays.get("frames_readings")


# Options of a stored calibration in words.

EMPTY: tuple[Any, ...] = (None, [], {})  # values of options that state nothing
# Units of options that are numbers [SI].
UNITS = {"limit_position": "m", "limit_angle": "rad", "volume": "[m, rad]"}
DIGITS = 12  # of a number, so that 15 um is not 1.4999999999999999e-05 m


def list_options(options: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return name and value of each stated option."""
    usual = FitOptions().to_dict()
    stated = {k: v for k, v in options["fit"].items() if v != usual.get(k)}
    stated |= {key: value for key, value in options.items() if key != "fit"}
    return [
        (
            f"option: {key.replace('_', ' ')}",
            str(Quantity(value, UNITS[key]))
            if isinstance(value, float) and key in UNITS
            else f"{describe_value(value)} {UNITS.get(key, '')}".strip(),
        )
        for key, value in stated.items()
        if value not in EMPTY
    ]


def describe_value(value: Any) -> str:
    """Return an option of plain data in words, such as `ridge (lam 0.1)`."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        if value and isinstance(value[0], list):  # a table, such as the points of a volume
            return f"{len(value)} rows"
        return ", ".join(map(describe_value, value))
    if not isinstance(value, dict):
        return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)
    if OBJECT in value:  # `Posterior(..)` of Python, formerly `<Posterior of ..>`
        return re.findall(r"\w+", str(value[OBJECT]))[0]
    settings = ", ".join(
        f"{k} {describe_value(v)}" for k, v in value.items() if k != "name" and v not in EMPTY
    )
    return f"{value['name']} ({settings})" if "name" in value else settings
