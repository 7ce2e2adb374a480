# SPDX-License-Identifier: Apache-2.0
"""A digital calibration certificate of a run: the XML of PTB's schema, DCC 3.3.0, with D-SI values.

Every value is in SI, with its expanded uncertainty (coverage probability 95 %). The certificate
states what the run states: parameters, errors at held-out poses and in a volume, conformity with
limits, and the instruments. Elements and their order: https://ptb.de/dcc/v3.3.0/; the values:
https://ptb.de/si/v2.2.1/.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, indent, register_namespace, tostring

import numpy as np

from loopcal.errors import DataError
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import Location, name_location, read_yaml
from loopcal.io.runs.run_folder import Run, refuse_changed_run
from loopcal.measure.observations import is_date
from loopcal.numerics.statistics import compute_f_quantile
from loopcal.plain_text import escape
from loopcal.results.tables import format_number, format_uncertainty, format_with_uncertainty
from loopcal.units import NUMBER, Dimension, find_unit

# Unit of a condition of the environment -> unit in the D-SI.
CONDITION_UNITS = {
    "degC": r"\degreecelsius",
    "K": r"\kelvin",
    "%": r"\percent",
    "hPa": r"\hecto\pascal",
}

CONDITION = re.compile(rf"({NUMBER.pattern})\s*({'|'.join(CONDITION_UNITS)})", NUMBER.flags)
# Key -> whether a text has its form, and the form in words.
FORMS: Mapping[str, tuple[Callable[[str], Any], str]] = {
    "country": (re.compile("[A-Z]{2}").fullmatch, "two capital letters, as DE"),
    "language": (re.compile("[a-z]{2}").fullmatch, "two lower-case letters, as en"),
    **dict.fromkeys(("begin", "end", "issued"), (is_date, "a date as 2026-01-31")),
    **dict.fromkeys(
        ("value", "plus_minus"), (CONDITION.fullmatch, "a number and its unit, 20 degC")
    ),
}

# Texts without which there is no certificate.
NEEDED: tuple[Location, ...] = (
    *((key,) for key in ("number", "country", "begin", "end")),
    *((key, "name") for key in ("machine", "laboratory", "customer")),
    *(("machine", "serial_number"), ("laboratory", "country"), ("customer", "country")),
    ("persons", 0, "name"),
)


@dataclass(frozen=True)
class _Texts:
    """A record whose texts are empty or have the form of their key."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            is_right, form = FORMS.get(field.name, (bool, ""))
            if form and value and not is_right(value):
                raise ValueError(f"{field.name} is {value!r}. Write {form}")


@dataclass(frozen=True)
class CalibratedMachine(_Texts):
    """The machine that was calibrated."""

    name: str = ""
    serial_number: str = ""
    manufacturer: str = ""
    model: str = ""


@dataclass(frozen=True)
class Contact(_Texts):
    """A laboratory or a customer."""

    name: str = ""
    country: str = ""
    city: str = ""
    street: str = ""
    post_code: str = ""
    email: str = ""

    def __str__(self) -> str:
        """Return name and address on one line."""
        place = (self.country, self.post_code, self.city) if self.city else ()
        return ", ".join(filter(None, (self.name, self.street, " ".join(filter(None, place)))))


@dataclass(frozen=True)
class Person(_Texts):
    """A person who answers for the certificate."""

    name: str = ""
    role: str = ""

    def __str__(self) -> str:
        return ", ".join(text for text in (self.name, self.role) if text)


@dataclass(frozen=True)
class Condition(_Texts):
    """A condition of the environment, such as 20.4 degC with the expanded uncertainty 0.6 K."""

    name: str
    value: str = ""
    plus_minus: str = ""

    def __str__(self) -> str:
        range_ = f" ± {self.plus_minus}" if self.plus_minus else ""
        return f"{self.name} {self.value}{range_}" if self.value else ""


@dataclass(frozen=True)
class Administration(_Texts):
    """Administrative data of a certificate; dates as 2026-01-31."""

    number: str = ""
    country: str = ""
    begin: str = ""
    end: str = ""
    machine: CalibratedMachine = CalibratedMachine()
    laboratory: Contact = Contact()
    customer: Contact = Contact()
    persons: tuple[Person, ...] = ()
    language: str = "en"
    place: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = (
        "laboratory"
    )
    issued: str = ""
    operator: str = ""
    environment: tuple[Condition, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.begin and self.end and self.end < self.begin:
            raise ValueError(f"end is {self.end}, before begin, {self.begin}. Correct one")

    def list_rows(self) -> dict[str, str]:
        """Return what a report shows, by the words that people read; a missing text is empty."""
        machine, days = self.machine, dict.fromkeys(filter(None, (self.begin, self.end)))
        made = " ".join(filter(None, (machine.manufacturer, machine.model)))
        at = self.customer if self.place.startswith("customer") else self.laboratory
        site = "" if self.place == "other" else ", ".join(filter(None, (at.name, at.city)))
        return {
            "certificate": self.number,
            "date": " to ".join(days),
            "customer": str(self.customer),
            "laboratory": str(self.laboratory),
            "machine": ", ".join(filter(None, (machine.name, made))),
            "serial number": machine.serial_number,
            "place": f"branch of {site}" if site and self.place.endswith("Branch") else site,
            "operator": self.operator,
            "environment": ", ".join(filter(None, map(str, self.environment))),
            "signed by": str(self.persons[0]) if self.persons else "",
            "issued": self.issued,
        }


def read_template() -> str:
    """Return the file of report facts to fill in."""
    return files("loopcal.io.runs").joinpath("report_facts.yaml").read_text("utf-8")


def load_administration(path: str | Path, is_complete: bool = True) -> Administration:
    """Read the administrative data of a certificate.

    is_complete : whether the texts that a certificate needs must be there.

    FileError : an unknown key, a needed text is empty, or one is not a date or code, at its line.
    """
    file = read_yaml(path, "file of report facts", has_names=False)
    facts = read_record(file, file.content, Administration, None)
    empty = []
    for location in NEEDED if is_complete else ():
        text: Any = facts
        for step in location:
            text = getattr(text, step) if isinstance(step, str) else (text or (Person(),))[step]
        empty += [] if text.strip() else [location]
    if empty:
        names = ", ".join(map(name_location, empty))
        raise file.error(f"a certificate needs these texts, which are empty: {names}", empty[0])
    return facts


DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
VERSION = "3.3.0"
ENGLISH = "en"  # the language of the results, whatever that of the facts
PROBABILITY = 0.95  # coverage probability of the stated intervals
SCOPE = (
    "The results concern the geometry in the region and under the conditions of the measured "
    "poses. They do not cover influences outside the measurement, such as other loads, "
    "temperatures or speeds."
)
# What the results and the statements on limits are about.
PREDICTED = (
    "The errors are of predicted poses at the recorded readings, without the measurement noise."
)

# Key of a bound of the error in a volume -> words.
VOLUME_BOUNDS = {
    "simultaneous": "simultaneously at all points",
    "pointwise": "pointwise, at a single point",
}

# Dimension -> unit in the D-SI; ratios have the unit one.
UNITS = {Dimension.LENGTH: r"\metre", Dimension.ANGLE: r"\radian"}
# Code of a decision on a limit -> word of the schema.
CONFORMITY = {
    "conformity.conforms": "pass",
    "conformity.fails": "fail",
    "conformity.undecided": "noPass",
}

# Characters that no XML document may hold.
NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
# Elements whose text is that of an element `content`.
IN_WORDS = ("name", "description", "declaration", "noQuantity")

Content = Mapping[str, Any]
"""Elements by name, in order: a text, elements, or a list for several of one name. Names without a
prefix are of the DCC. Elements without any content are left out.
"""


def format_certificate(run: Run, administration: Administration) -> str:
    """Return the certificate of a run as XML.

    run : a run folder. administration : what the run does not know; see `load_administration`.

    DataError : a robot file instead of a run, or a run that failed.
    FileError : `files.run-changed`.
    """
    if not run.result:
        raise DataError(f"{run.path} is a robot file, which has no result. Give a run folder")
    if run.failure is not None:
        raise DataError(run.failure)
    refuse_changed_run(run)
    for prefix, uri in (("dcc", DCC), ("si", SI), ("xsi", XSI)):
        register_namespace(prefix, uri)
    root = Element(f"{{{DCC}}}digitalCalibrationCertificate", schemaVersion=VERSION)
    root.set(f"{{{XSI}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    release = str(run.result["made_by"].get("versions", {}).get("loopcal", "unknown"))
    software = {"software": {"name": "loopcal", "release": release}}
    method = "Identification of geometric parameters, validated on held-out poses"
    instruments = [_describe_instrument(facts) for facts in run.result.get("instruments") or []]
    result = {
        "name": "Geometric calibration",
        "usedMethods": {"usedMethod": {"name": method, "norm": "JCGM 100:2008"}},
        "usedSoftware": software,
        "measuringEquipments": {"measuringEquipment": instruments},
        "influenceConditions": {
            "influenceCondition": list(map(_describe_condition, administration.environment))
        },
        "results": {"result": list(_list_results(run))},
        "measurementMetaData": {"metaData": list(_list_statements(run.result))},
    }
    administrative = {"dccSoftware": software, **_describe_administration(administration)}
    measured = {"measurementResult": result}
    _add(root, {"administrativeData": administrative, "measurementResults": measured})
    indent(root)
    return tostring(root, "unicode", xml_declaration=False).join(
        ['<?xml version="1.0" encoding="UTF-8"?>\n', "\n"]
    )


def _add(parent: Element, content: Content) -> None:
    """Add elements."""
    for name, value in content.items():
        for entry in value if isinstance(value, list) else [value]:
            prefix, _, local = name.rpartition(":")
            element = Element(f"{{{SI if prefix else DCC}}}{local}")
            if not isinstance(entry, str):
                _add(element, entry)
            elif entry and name in IN_WORDS:
                _add(element, {"content": entry})
            elif entry:
                # XML does not hold all characters: the others become visible escapes
                text = NOT_XML.sub(lambda match: escape(match.group()), entry)
                element.text = text.strip() or "-"
            if element.text or len(element):
                parent.append(element)


def _identify(numbers: Mapping[str, str], issuer: str) -> Content:
    """Return numbers that identify something, by what they are."""
    entries = ((name, value) for name, value in numbers.items() if value)
    return {"identification": [{"issuer": issuer, "value": v, "name": n} for n, v in entries]}


def _describe_administration(facts: Administration) -> Content:
    """Return the administrative data, in the order of the schema."""
    machine = facts.machine
    item = {
        "name": machine.name,
        "manufacturer": {"name": machine.manufacturer},
        "model": machine.model,
        "identifications": _identify({"serial number": machine.serial_number}, "manufacturer"),
    }
    persons = [
        {
            "person": {"name": person.name},
            "role": person.role,
            "mainSigner": "false" if i else "true",
        }
        for i, person in enumerate(facts.persons)
    ]
    if facts.operator:
        operator = {"person": {"name": facts.operator}, "role": "operator", "mainSigner": "false"}
        persons.append(operator)
    return {
        "coreData": {
            "countryCodeISO3166_1": facts.country,
            "usedLangCodeISO639_1": list(dict.fromkeys((ENGLISH, facts.language))),
            "mandatoryLangCodeISO639_1": ENGLISH,
            "uniqueIdentifier": facts.number,
            "beginPerformanceDate": facts.begin,
            "endPerformanceDate": facts.end,
            "performanceLocation": facts.place,
            "issueDate": facts.issued,
        },
        "items": {"item": item},
        "calibrationLaboratory": {"contact": _describe_contact(facts.laboratory)},
        "respPersons": {"respPerson": persons},
        "customer": _describe_contact(facts.customer),
    }


def _describe_contact(contact: Contact) -> Content:
    """Return name and address."""
    location = {
        "street": contact.street,
        "postCode": contact.post_code,
        "city": contact.city,
        "countryCode": contact.country,
    }
    return {"name": contact.name, "eMail": contact.email, "location": location}


def _describe_instrument(facts: Mapping[str, str]) -> Content:
    """Return an instrument that the measurement files state."""
    sources = ("laboratory", "standard", "calibrated", "due", "measured")
    description = "; ".join(f"{key} {facts[key]}" for key in sources if key in facts)
    known = {"serial number": "serial_number", "certificate": "certificate"}
    numbers = {name: facts.get(key, "") for name, key in known.items()}
    return {
        "name": facts.get("name") or facts.get("model") or "instrument",
        "description": description,
        "manufacturer": {"name": facts.get("manufacturer", "")},
        "model": facts.get("model", ""),
        "identifications": _identify(numbers, "other"),
    }


def _describe_condition(condition: Condition) -> Content:
    """Return a condition of the environment; nothing without a value."""
    stated = [CONDITION.fullmatch(text) for text in (condition.value, condition.plus_minus)]
    if stated[0] is None:
        return {}
    unit, half = CONDITION_UNITS[stated[0][2]], stated[1][1] if stated[1] else ""
    quantity = _state(condition.name, unit, stated[0][1], half, "2")
    return {"name": condition.name, "data": {"quantity": [quantity]}}


def _list_results(run: Run) -> Iterator[Content]:
    """Yield the parameters with their covariance, and errors in a volume and at held-out poses."""
    content = run.result
    parameters = []
    for row in content["fit"]["parameters"]:
        unit = find_unit(row["unit"] or "1")
        values = (row["estimate"], row["plus_minus"], row["sd"])
        scaled = (None if x is None else x * unit.factor_to_si for x in values)
        parameters.append(_quantity(row["name"], UNITS.get(unit.dimension, r"\one"), *scaled))
    degrees = min((row["degrees"] or math.inf for row in content["fit"]["parameters"]), default=0.0)
    covariance = _describe_covariance(run.arrays.get("covariance"), parameters, degrees)
    yield {"name": "Identified parameters", "data": {"quantity": [*parameters, *covariance]}}
    if volume := content.get("volume"):
        bound = "upper bound of the position error with a coverage probability of 95 %"
        bounds = [
            _quantity(f"{bound}, {words}", r"\metre", volume[name])
            for name, words in VOLUME_BOUNDS.items()
        ]
        name = f"Position error in the working volume, {volume['frame']}"
        yield {"name": name, "data": {"quantity": bounds}}
    yield from _list_budgets(content.get("expected_error") or {})
    errors = content.get("validation")
    if not errors:
        return
    quantities = [
        _quantity(f"{quantity} error {when} calibration, {word}", unit, errors[when][quantity][key])
        for when in ("before", "after")
        for quantity, unit in (("position", r"\metre"), ("orientation", r"\radian"))
        if quantity in errors[when]
        for key, word in (("rms", "root mean square"), ("max", "largest"))
    ]
    if quantities:
        name = f"Errors at held-out poses, {errors['frame']}"
        yield {"name": name, "data": {"quantity": quantities}}


def _list_budgets(budget: Mapping[str, Any]) -> Iterator[Content]:
    """Yield the standard uncertainty that each source contributes, as stated and in sum."""
    for kind, unit in (("position", r"\metre"), ("orientation", r"\radian")):
        quantities = []
        for line in budget.get("sources", ()):
            facts = [line.get("words") or line["kind"], f"type {line['evaluation']}"]
            if stated := line.get("stated"):
                how = f"{stated['distribution']}, divisor {stated['divisor']:.3g}"
                facts.append(f"stated {stated['value']:.6g} {stated['unit']}, {how}")
            if line["degrees"] is not None and math.isfinite(line["degrees"]):
                facts.append(f"degrees of freedom {line['degrees']:.0f}")
            quantities.append(_quantity("; ".join(facts), unit, math.sqrt(line[kind] or 0.0)))
        if quantities and budget[kind]["rms"]:
            quantities.append(_quantity("all sources", unit, budget[kind]["rms"]))
            name = f"Uncertainty budget of the {kind}, k = 1, root mean square over the workspace"
            yield {"name": name, "data": {"quantity": quantities}}


def _describe_covariance(
    covariance: np.ndarray | None, parameters: Sequence[Content], degrees: float
) -> list[Content]:
    """Return the parameters of finite variance as one list with their covariance (p, p) [SI].

    Rounded to two digits of an uncertainty, a matrix of correlated parameters has negative
    eigenvalues, so covariances have ten digits (JCGM 102, 7.2.6 asks for enough of them).
    """
    if covariance is None:
        return []
    variance = np.diag(covariance)
    kept = np.flatnonzero(np.isfinite(variance) & (variance > 0.0)).tolist()
    if len(kept) < 2:
        return []
    stated = [parameters[i]["si:real"] for i in kept]
    units = [real["si:unit"] for real in stated]
    products = {(a, b): f"{a}{b}".replace(r"\one", "") for a in units for b in units}
    products |= {(a, a): a if a == r"\one" else rf"{a}\tothe{{2}}" for a in units}
    columns = [
        {
            "si:covarianceXMLList": {
                "si:valueXMLList": " ".join(f"{x:.10g}" for x in covariance[kept, k]),
                "si:unitXMLList": " ".join(products[unit, units[j]] for unit in units),
            }
        }
        for j, k in enumerate(kept)
    ]
    # JCGM 102, 6.5, with the fewest degrees of freedom of a parameter
    square = len(kept) * float(compute_f_quantile(len(kept), degrees, 1.0 - PROBABILITY))
    region = {
        "si:covarianceMatrixXMLList": {"si:columnXMLList": columns},
        "si:coverageFactorXMLList": f"{square**0.5:.3g}",
        "si:coverageProbabilityXMLList": repr(PROBABILITY),
    }
    values = {
        "si:labelXMLList": " ".join(parameters[i]["name"] for i in kept),
        "si:valueXMLList": " ".join(real["si:value"] for real in stated),
        "si:unitXMLList": " ".join(units),
        "si:measurementUncertaintyMultivariateXMLList": {"si:ellipsoidalRegionMUXMLList": region},
    }
    return [{"name": "Covariance of the identified parameters", "si:realListXMLList": values}]


def _quantity(
    name: str,
    unit: str,
    value: float | None,
    expanded: float | None = None,
    sd: float | None = None,
) -> Content:
    """Return a value [SI] with its expanded uncertainty; a text where it is not determined."""
    if value is None or not math.isfinite(value):
        return {"name": name, "noQuantity": "not determined by the measurements"}
    if not (expanded and sd and math.isfinite(expanded)):
        return _state(name, unit, format_number(value, 3))
    shown = format_with_uncertainty(value, expanded), format_uncertainty(expanded)
    return _state(name, unit, *shown, format_number(expanded / sd, 3))


def _state(name: str, unit: str, value: str, expanded: str = "", factor: str = "") -> Content:
    """Return a value as written, with its expanded uncertainty, if any, and coverage factor."""
    uncertainty = {
        "si:valueExpandedMU": expanded,
        "si:coverageFactor": factor,
        "si:coverageProbability": repr(PROBABILITY),
    }
    univariate = {"si:expandedMU": uncertainty} if expanded else {}
    real = {"si:value": value, "si:unit": unit, "si:measurementUncertaintyUnivariate": univariate}
    return {"name": name, "si:real": real}


def _list_statements(content: Mapping[str, Any]) -> Iterator[Content]:
    """Yield the verdict with what it is subject to, and the statement on each limit."""
    stated = [f for f in content.get("findings") or () if f["severity"] == "warning"]
    expected = (content.get("expected_error") or {}).get("finding")
    if expected and content.get("states_expected_error"):
        stated.append(expected)
    sentences = [content["headline"], *(f["text"] for f in stated), SCOPE]
    sentences += filter(None, [content["fit"].get("interval_note")])  # whether U rests on a prior
    yield {"name": "Verdict, warnings and expected error", "declaration": " ".join(sentences)}
    volume = content.get("volume") or {"findings": ()}
    if told := [f["text"] for f in volume["findings"] if not f["code"].startswith("conformity.")]:
        yield {"name": "Position error in the working volume", "declaration": " ".join(told)}
    at_poses = (content.get("validation") or {}).get("findings", ())
    for finding in (f for f in (*at_poses, *volume["findings"]) if f["code"] in CONFORMITY):
        is_volume = finding["data"]["is_volume"]
        where = "in the working volume" if is_volume else "at held-out poses"
        yield {
            "name": f"Conformity of the largest {finding['data']['quantity']} error {where}",
            "norm": "ISO 14253-1:2017",
            "declaration": finding["text"] if is_volume else f"{finding['text']} {PREDICTED}",
            "conformity": CONFORMITY[finding["code"]],
        }
