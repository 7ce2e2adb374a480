# SPDX-License-Identifier: Apache-2.0
"""What a digital calibration certificate states beside the results: laboratory, customer, dates."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Literal

from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import YamlFile, read_yaml

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
