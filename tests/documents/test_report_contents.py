# SPDX-License-Identifier: Apache-2.0
"""Every content that a report must have is in its section, of one calibration that has them all."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.documents import load_record
from loopcal.io.runs.certificate import read_template
from loopcal.report.document.elements import Document, Form, Listing, Picture, Section, list_options
from loopcal.report.document.sections import build_calibration_document, build_sections
from loopcal.report.words import say
from loopcal.results.tables import Table
from tests.io.test_instruments import FACTS, data, robot, with_instrument  # noqa: F401

pytestmark = pytest.mark.slow

LIMIT = 60e-6
"""Limit on the position error [m]."""

VOLUME = lc.Volume({"x": (-0.02, 0.02)}, {"y": [0.25]})


@pytest.fixture(scope="module")
def report(robot, data) -> lc.CalibrationReport:  # noqa: F811
    """Return a calibration with an instrument, a limit, times, temperatures and an excluded row."""
    (rows,) = with_instrument(data, FACTS | {"due": "2025-02-01"}).observations
    count = len(rows)
    measured = rows.measured.copy()
    measured[3] += 0.4e-3
    context = {"time": 60.0 * np.arange(count), "temperature": 20.0 + 0.1 * np.arange(count)}
    changed = replace(data, observations=(replace(rows, measured=measured, context=context),))
    held_out = tuple(data.labels[6::4])
    fit = lc.FitOptions(excluded_poses=("4",))
    options = lc.CalibrationOptions(fit=fit, held_out=held_out, limit_position=LIMIT, volume=VOLUME)
    return lc.calibrate(robot, changed, options)


@pytest.fixture(scope="module")
def document(report, tmp_path_factory) -> Document:
    path = tmp_path_factory.mktemp("facts") / "facts.yaml"
    path.write_text(read_template().replace('serial_number: ""', 'serial_number: "0017"'), "utf-8")
    return build_calibration_document(load_record(report, path))


def get_section(document: Document, name: str) -> Section:
    return next(section for section in document.sections if section.name == name)


def write_text(section: Section) -> str:
    """Return all text of a section."""
    parts = []
    for element in section.elements:
        if isinstance(element, str):
            parts.append(element)
        elif isinstance(element, Table):
            parts.append(element.to_text())
        elif isinstance(element, Listing):
            parts += [text for _, text in element.items]
        elif isinstance(element, Picture):
            parts += [element.caption, element.description, *re.findall(r">([^<>]+)<", element.svg)]
        elif isinstance(element, Form):
            parts += [f"{label}: {text}" for label, text in element.rows]
        else:
            parts.append(element.text)
    return "\n".join(parts)


CONTENTS = [
    ("summary", r"machine: five-bar\nserial number: 0017\n.*certificate D-K-15123-01"),
    ("summary", r"environment: \n"),  # a line to fill in
    ("summary", r"position, upper bound in the working volume.* [\d.]+ um +60 um +conforms"),
    ("summary", r"position, largest at \d+ held-out poses"),
    ("summary", r"Decision rule: ISO 14253-1, JCGM 106.*at least 95 %"),
    ("summary", r"Working volume: box x -20 mm to 20 mm, y 250 mm"),
    ("verdict", r"Scope: the verdict concerns the geometry of five-bar .*fitted.*held out"),
    ("verdict", r"Expected error over the workspace: position"),
    ("verdict", r"Share of each source in the variance"),
    (
        "summary",
        r"against the limit 60 um: conforms\. .*is (?:more than )?[\d.]+ %",
    ),  # guard-banded
    (
        "budget",
        r"\(box x -20 mm to 20 mm, y 250 mm\), the position error is at most .*, simultaneously",
    ),
    ("summary", r"in the volume: .* against the limit 60 um"),
    ("determined", r"The data determine all \d+ parameters"),
    ("outliers", r"No outliers among .*Excluded from the fit by its options: 4\."),
    ("errors", r"Before: .*frames.*After: .*Noise floor: "),
    ("errors", r"rms +\d+ +[\d.]+ +[\d.]+ +[\d.]+"),
    ("residuals", r"Chi-square is [\d.]+ with .* for a sigma with an uncertainty of 25 %"),
    ("residuals", r"histogram"),
    ("residuals", r"normal"),
    ("residuals", r"time \["),
    ("residuals", r"temperature \["),
    ("residuals", r"reading left \[deg\]"),
    ("workspace", r"Slices of the workspace"),
    ("workspace", r"less certain than every measured pose"),
    ("parameters", r"shift \[expected spreads\]"),
    ("parameters", r"Correlations of the parameters"),
    ("budget", r"JCGM|type A"),
    ("budget", r"D-K-15123-01"),  # traceability
    ("budget", r"0750123"),
    ("budget", r"2025-01-15"),
    ("controller", r"loopcal export"),
    ("verdict", r"AT960.*2025-02-01"),
    ("provenance", r"version of loopcal"),
    ("provenance", r"seed: hold_out"),
    ("poses", r"18 fitted poses: "),
    ("poses", r"5 held-out poses: 7, 11, 15, 19, 23\."),
]


@pytest.mark.parametrize(("name", "pattern"), CONTENTS, ids=[f"{n}: {p}" for n, p in CONTENTS])
def test_section_has_its_content(document, name, pattern) -> None:
    assert re.search(pattern, write_text(get_section(document, name)), re.DOTALL)


def test_missed_limit_is_not_called_a_gate_that_is_met(report) -> None:
    record = load_record(report)
    missed = {**record.result, "verdict": "reservations", "passed": False}
    said = build_sections(replace(record, result=missed), ["verdict"])[0].elements[0]
    assert str(said) == say("verdict.limit-missed")
    kept = {**missed, "passed": True}
    said = build_sections(replace(record, result=kept), ["verdict"])[0].elements[0]
    assert str(said) == say("verdict.reservations")


def test_combinations_that_only_move_frames_are_counted_and_the_first_others_listed(report) -> None:
    record = load_record(report)

    def state(i: int, meaning: str) -> dict[str, object]:
        stated = {"names": [f"p{i}"], "meaning": meaning}
        return {
            "code": "fit.unidentifiable",
            "severity": "info",
            "text": f"open p{i}",
            "data": stated,
        }

    findings = [state(i, "" if i % 2 else "shifting the base frame") for i in range(40)]
    remedies = [{"names": [f"p{i}"], "finding": {"text": f"cure p{i}"}} for i in range(40)]
    result = {**record.result, "findings": findings, "remedies": remedies}
    (section,) = build_sections(replace(record, result=result), ["determined"])
    text = write_text(section)
    assert re.findall(r"open p(\d+)", text) == [str(i) for i in range(1, 16, 2)]
    assert re.findall(r"cure p(\d+)", text) == [str(i) for i in range(1, 16, 2)]
    assert "leaves out 32 combinations" in text


def test_a_note_is_in_one_section_only(document, report) -> None:
    listed = [
        (label, text)
        for section in document.sections
        for element in section.elements
        if isinstance(element, Listing)
        for label, text in element.items
    ]
    notes = [text for label, text in listed if label == "info"]
    assert notes
    assert len(notes) == len(set(notes))
    shown = {text for _, text in listed}
    assert {str(finding) for finding in report.findings} <= shown


def test_provenance_words_options_and_method_without_python(document) -> None:
    text = write_text(get_section(document, "provenance"))
    assert re.search(r"option: limit position +0.06 mm", text)
    assert re.search(r"option: held out +7, 11, 15, 19, 23", text)
    assert re.search(r"option: check conventions +yes", text)
    assert re.search(r"method +MAP$", text, re.MULTILINE)
    assert not re.search(r"CalibrationOptions|None|True|False|\(\)|='", text)


def test_stored_options_are_worded() -> None:
    fit = lc.FitOptions(noise="estimated", loss=lc.Huber(2.0)).to_dict()
    options = {"fit": fit, "seed": 3, "prior": {"object": "Posterior(places=<3 array>)"}}
    options["limit_position"] = 0.015 * 1e-3  # 1.4999999999999999e-05
    assert list_options(options | {"choose_model": True, "compare_with": None}) == [
        ("option: loss", "huber (k 2)"),
        ("option: noise", "estimated"),
        ("option: seed", "3"),
        ("option: prior", "Posterior"),
        ("option: limit position", "0.015 mm"),
        ("option: choose model", "yes"),
    ]
