# SPDX-License-Identifier: Apache-2.0
"""A digital calibration certificate of a run: the XML of PTB's schema, DCC 3.3.0, with D-SI values.

Every value is in SI, with its expanded uncertainty (coverage probability 95 %); sentences for
people are in mm and deg. The certificate states what the run states: parameters, errors at
held-out poses, conformity with limits, and the instruments. Elements and their order:
https://ptb.de/dcc/v3.3.0/; the values: https://ptb.de/si/v2.2.1/.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from xml.etree.ElementTree import Element, SubElement, indent, register_namespace, tostring

from loopcal.errors import DataError
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import YamlFile, read_yaml
from loopcal.io.runs.run_folder import refuse_changed_run
from loopcal.plain_text import escape
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from loopcal.io.runs.run_folder import Run


# What a digital calibration certificate states beside the results: laboratory, customer,
# dates.

WHAT = "certificate file"

TEMPLATE = """\
# What a digital calibration certificate states beside the results. Fill in every text.
number: "2026-001"            # unique identifier of the certificate
language: en                  # ISO 639, two lower-case letters
country: DE                   # where it is issued, ISO 3166, two capitals
place: laboratory             # laboratory, customer, laboratoryBranch, customerBranch or other
begin: 2026-01-31             # first and last day of the calibration, and day of issue
end: 2026-01-31
issued: 2026-01-31
machine: {name: "", manufacturer: "", model: "", serial_number: ""}
laboratory: {name: "", city: "", country: DE, street: "", post_code: "", email: ""}
customer: {name: "", city: "", country: DE, street: "", post_code: "", email: ""}
persons:                      # who answers for it; the signer first
  - {name: "", role: ""}
"""
"""The file to fill in."""

NEEDED: Mapping[str, tuple[str, ...]] = {
    "machine": ("name", "serial_number"),
    "laboratory": ("name",),
    "customer": ("name",),
}
"""Texts that must not be empty."""


@dataclass(frozen=True)
class CalibratedMachine:
    """The machine that was calibrated."""

    name: str
    serial_number: str
    manufacturer: str = ""
    model: str = ""


@dataclass(frozen=True)
class Contact:
    """A laboratory or a customer."""

    name: str
    country: str
    city: str = ""
    street: str = ""
    post_code: str = ""
    email: str = ""


@dataclass(frozen=True)
class Person:
    """A person who answers for the certificate."""

    name: str
    role: str = ""


@dataclass(frozen=True)
class Administration:
    """Administrative data of a certificate; dates as 2026-01-31."""

    number: str
    country: str
    begin: str
    end: str
    machine: CalibratedMachine
    laboratory: Contact
    customer: Contact
    persons: tuple[Person, ...]
    language: str = "en"
    place: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = (
        "laboratory"
    )
    issued: str = ""


def load_administration(path: str | Path) -> Administration:
    """Read the administrative data of a certificate.

    Raises
    ------
    FileError : a key is missing or unknown, a text is empty, or not a date or code, at its line.
    """
    file = read_yaml(path, WHAT, has_names=False)
    record = read_record(file, file.content, Administration, None)
    for owner, keys in NEEDED.items():
        for key in keys:
            if not getattr(getattr(record, owner), key).strip():
                raise file.error(f"'{owner}.{key}' is empty; fill it in", (owner, key))
    if not record.number.strip():
        raise file.error("'number' is empty; fill it in", ("number",))
    if not record.persons or not all(person.name.strip() for person in record.persons):
        raise file.error("'persons' needs at least one name; fill it in", ("persons",))
    _check_codes(file, record)
    for key in ("begin", "end", "issued"):
        _check_date(file, key, getattr(record, key))
    if record.end < record.begin:
        raise file.error(
            f"end is {record.end}, before begin, {record.begin}; correct one", ("end",)
        )
    return record


def _check_codes(file: YamlFile, record: Administration) -> None:
    """Refuse codes of countries and languages that the schema does not accept."""
    codes = {("country",): record.country}
    codes |= {("laboratory", "country"): record.laboratory.country}
    codes |= {("customer", "country"): record.customer.country}
    for place, code in codes.items():
        if not re.fullmatch("[A-Z]{2}", code):
            name = ".".join(place)
            raise file.error(f"{name!r} is {code!r}; write two capital letters, as DE", place)
    if not re.fullmatch("[a-z]{2}", record.language):
        sentence = f"language is {record.language!r}; write two lower-case letters, as en"
        raise file.error(sentence, ("language",))


def _check_date(file: YamlFile, key: str, text: str) -> None:
    """Refuse a text that is no date of the form 2026-01-31; `issued` may be left out."""
    if key == "issued" and not text:
        return
    try:
        is_date = date.fromisoformat(text).isoformat() == text
    except ValueError:
        is_date = False
    if not is_date:
        raise file.error(f"{key} is {text!r}; write a date as 2026-01-31", (key,))


DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
VERSION = "3.3.0"
PROBABILITY = 0.95
"""Coverage probability of the stated intervals."""

SCOPE = (
    "The results concern the geometry in the region and under the conditions of the measured "
    "poses. They do not cover errors that did not act during the measurement, such as those of "
    "other loads, temperatures or speeds."
)
PREDICTED = (
    "The error is that of predicted poses at the recorded readings, without the noise of the "
    "measurement."
)
"""What the results and the statements on limits are about."""

UNITS = {Dimension.LENGTH: r"\metre", Dimension.ANGLE: r"\radian"}
"""Dimension -> unit in the D-SI; ratios have the unit one."""

CONFORMITY = {
    "conforms": "pass",
    "does not conform": "fail",
    "neither conforms nor fails": "noPass",
}
"""Decision on a limit -> word of the schema."""

NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML document may hold."""


def format_certificate(run: Run, administration: Administration) -> str:
    """Return the certificate of a run as XML.

    Parameters
    ----------
    run : a run folder. administration : what the run does not know; see `load_administration`.

    Raises
    ------
    DataError : a robot file instead of a run, or a run that failed.
    FileError : `files.run-changed`.
    """
    if not run.result:
        raise DataError(f"{run.path} is a robot file, which states no result; give a run folder")
    if run.failure is not None:
        raise DataError(run.failure)
    refuse_changed_run(run)
    for prefix, uri in (("dcc", DCC), ("si", SI), ("xsi", XSI)):
        register_namespace(prefix, uri)
    root = Element(f"{{{DCC}}}digitalCalibrationCertificate", schemaVersion=VERSION)
    root.set(f"{{{XSI}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    _add_administration(_add(root, "administrativeData"), run, administration)
    result = _add(_add(root, "measurementResults"), "measurementResult")
    _add_text(result, "name", "Geometric calibration")
    method = _add(_add(result, "usedMethods"), "usedMethod")
    _add_text(method, "name", "Identification of geometric parameters, validated on held-out poses")
    _add(method, "norm", "JCGM 100:2008")
    _add_software(_add(result, "usedSoftware"), run)
    _add_instruments(result, run.result.get("instruments") or [])
    _add_results(_add(result, "results"), run.result)
    _add_statements(_add(result, "measurementMetaData"), run.result)
    indent(root)
    return tostring(root, "unicode", xml_declaration=False).join(
        ['<?xml version="1.0" encoding="UTF-8"?>\n', "\n"]
    )


def _add(parent: Element, name: str, text: str | None = None) -> Element:
    """Add an element of the DCC."""
    element = SubElement(parent, f"{{{DCC}}}{name}")
    if text is not None:
        # XML does not hold all characters: the others become visible escapes
        element.text = NOT_XML.sub(lambda match: escape(match.group()), text).strip() or "-"
    return element


def _add_text(parent: Element, name: str, text: str) -> None:
    """Add an element with a text in words."""
    _add(_add(parent, name), "content", text)


def _add_software(parent: Element, run: Run) -> None:
    """Add the program that computed the results."""
    software = _add(parent, "software")
    _add_text(software, "name", "loopcal")
    versions = run.result["made_by"].get("versions", {})
    _add(software, "release", str(versions.get("loopcal", "unknown")))


def _add_administration(parent: Element, run: Run, facts: Administration) -> None:
    """Add the administrative data, in the order of the schema."""
    _add_software(_add(parent, "dccSoftware"), run)
    core = _add(parent, "coreData")
    _add(core, "countryCodeISO3166_1", facts.country)
    _add(core, "usedLangCodeISO639_1", facts.language)
    _add(core, "mandatoryLangCodeISO639_1", facts.language)
    _add(core, "uniqueIdentifier", facts.number)
    _add(core, "beginPerformanceDate", facts.begin)
    _add(core, "endPerformanceDate", facts.end)
    _add(core, "performanceLocation", facts.place)
    if facts.issued:
        _add(core, "issueDate", facts.issued)
    machine = facts.machine
    item = _add(_add(parent, "items"), "item")
    _add_text(item, "name", machine.name)
    if machine.manufacturer:
        _add_text(_add(item, "manufacturer"), "name", machine.manufacturer)
    if machine.model:
        _add(item, "model", machine.model)
    _add_identifications(item, {"serial number": machine.serial_number}, "manufacturer")
    _add_contact(_add(_add(parent, "calibrationLaboratory"), "contact"), facts.laboratory)
    persons = _add(parent, "respPersons")
    for i, person in enumerate(facts.persons):
        entry = _add(persons, "respPerson")
        _add_text(_add(entry, "person"), "name", person.name)
        if person.role:
            _add(entry, "role", person.role)
        _add(entry, "mainSigner", "true" if i == 0 else "false")
    _add_contact(_add(parent, "customer"), facts.customer)


def _add_contact(parent: Element, contact: Contact) -> None:
    """Add name and address."""
    _add_text(parent, "name", contact.name)
    if contact.email:
        _add(parent, "eMail", contact.email)
    location = _add(parent, "location")
    place = {"street": contact.street, "postCode": contact.post_code, "city": contact.city}
    for name, text in place.items():
        if text:
            _add(location, name, text)
    _add(location, "countryCode", contact.country)


def _add_identifications(parent: Element, values: Mapping[str, str], issuer: str) -> None:
    """Add numbers that identify something."""
    listed = _add(parent, "identifications")
    for name, value in values.items():
        identification = _add(listed, "identification")
        _add(identification, "issuer", issuer)
        _add(identification, "value", value)
        _add_text(identification, "name", name)


def _add_instruments(parent: Element, instruments: list[Mapping[str, str]]) -> None:
    """Add the instruments that the measurement files state."""
    if not instruments:
        return
    equipments = _add(parent, "measuringEquipments")
    for facts in instruments:
        equipment = _add(equipments, "measuringEquipment")
        _add_text(equipment, "name", facts.get("name") or facts.get("model") or "instrument")
        dates = [f"{k} {facts[k]}" for k in ("calibrated", "due", "measured") if k in facts]
        sources = [f"{k} {facts[k]}" for k in ("laboratory", "standard") if k in facts]
        if dates or sources:
            _add_text(equipment, "description", "; ".join([*sources, *dates]))
        if "manufacturer" in facts:
            _add_text(_add(equipment, "manufacturer"), "name", facts["manufacturer"])
        if "model" in facts:
            _add(equipment, "model", facts["model"])
        known = {"serial number": "serial_number", "certificate": "certificate"}
        numbers = {name: facts[key] for name, key in known.items() if key in facts}
        if numbers:
            _add_identifications(equipment, numbers, "other")


def _add_results(parent: Element, content: Mapping[str, Any]) -> None:
    """Add the parameters, and the errors at held-out poses."""
    data = _add_result(parent, "Identified parameters")
    for row in content["fit"]["parameters"]:
        unit = find_unit(row["unit"] or "1")
        values = (row["estimate"], row["plus_minus"], row["sd"])
        scaled = (None if x is None else x * unit.factor_to_si for x in values)
        _add_quantity(data, row["name"], UNITS.get(unit.dimension, r"\one"), *scaled)
    errors = content.get("validation")
    if not errors:
        return
    rows = [
        (f"{quantity} error {when} calibration, {word}", unit_name, errors[when][quantity][key])
        for when in ("before", "after")
        for quantity, unit_name in (("position", r"\metre"), ("orientation", r"\radian"))
        if quantity in errors[when]
        for key, word in (("rms", "root mean square"), ("max", "largest"))
    ]
    if rows:
        data = _add_result(parent, f"Errors at held-out poses, {errors['frame']}")
        for name, unit_name, value in rows:
            _add_quantity(data, name, unit_name, value)


def _add_result(parent: Element, name: str) -> Element:
    """Add a result, and return the element of its data."""
    result = _add(parent, "result")
    _add_text(result, "name", name)
    return _add(result, "data")


def _add_quantity(
    parent: Element,
    name: str,
    unit: str,
    value: float | None,
    expanded: float | None = None,
    sd: float | None = None,
) -> None:
    """Add a value [SI] with its expanded uncertainty; a text where it is not determined."""
    quantity = _add(parent, "quantity")
    _add_text(quantity, "name", name)
    if value is None or not math.isfinite(value):
        _add_text(quantity, "noQuantity", "not determined by the measurements")
        return
    real = SubElement(quantity, f"{{{SI}}}real")
    for key, text in (("value", repr(float(value))), ("unit", unit)):
        SubElement(real, f"{{{SI}}}{key}").text = text
    if not expanded or not sd:
        return
    univariate = SubElement(real, f"{{{SI}}}measurementUncertaintyUnivariate")
    uncertainty = SubElement(univariate, f"{{{SI}}}expandedMU")
    numbers = {
        "valueExpandedMU": expanded,
        "coverageFactor": expanded / sd,
        "coverageProbability": PROBABILITY,
    }
    for key, number in numbers.items():
        SubElement(uncertainty, f"{{{SI}}}{key}").text = repr(float(number))


def _add_statements(parent: Element, content: Mapping[str, Any]) -> None:
    """Add the verdict with what it is subject to, and the statement on each limit."""
    stated = [f for f in content.get("findings") or () if f["severity"] == "warning"]
    expected = (content.get("expected_error") or {}).get("finding")
    if expected and content.get("states_expected_error"):
        stated.append(expected)
    headline = content.get("headline")  # absent in runs of earlier versions
    sentences = [*([headline] if headline else []), *(f["text"] for f in stated)]
    verdict = _add(parent, "metaData")
    _add_text(verdict, "name", "Verdict, warnings and expected error")
    _add_text(verdict, "declaration", " ".join((*sentences, SCOPE)))
    judged = ((content.get("validation") or {}).get("conformity")) or {}
    for quantity, stated in judged.items():
        meta = _add(parent, "metaData")
        unit, scale = ("mm", 1e3) if quantity == "position" else ("deg", math.degrees(1.0))
        _add_text(meta, "name", f"Conformity of the largest {quantity} error at held-out poses")
        _add(meta, "norm", "ISO 14253-1:2017")
        numbers = {
            "estimate": "Estimate",
            "expanded": "expanded uncertainty",
            "limit": "limit",
            "guard_band": "guard band",
            "acceptance_limit": "acceptance limit",
        }
        lengths = (f"{words} {stated[k] * scale:.3g} {unit}" for k, words in numbers.items())
        declaration = (
            f"{', '.join(lengths)}, probability of conformity {100 * stated['probability']:.3g} %; "
            f"conformity is accepted from {100 * stated['level']:.3g} %. {PREDICTED}"
        )
        _add_text(meta, "declaration", declaration)
        _add(meta, "conformity", CONFORMITY[stated["decision"]])
