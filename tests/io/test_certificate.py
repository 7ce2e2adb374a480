# SPDX-License-Identifier: Apache-2.0
"""Digital calibration certificates: elements and order of DCC 3.3.0, SI values, hostile names."""

import json
import math
import os
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError
from loopcal.io.runs import certificate
from loopcal.io.runs.certificate import format_certificate, load_administration, read_template
from loopcal.io.runs.run_folder import load_run_or_robot
from tests.io.test_instruments import FACTS, data, robot, with_instrument  # noqa: F401

CONTACT = "name eMail? phone? fax? link? location?"
RULES = {
    "digitalCalibrationCertificate": "administrativeData measurementResults",
    "administrativeData": "dccSoftware coreData items calibrationLaboratory respPersons customer",
    "dccSoftware": "software+",
    "usedSoftware": "software+",
    "software": "name release",
    "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1+ mandatoryLangCodeISO639_1+ "
    "uniqueIdentifier identifications? receiptDate? beginPerformanceDate endPerformanceDate "
    "performanceLocation issueDate?",
    "items": "item+",
    "item": "name manufacturer? model? identifications",
    "identifications": "identification+",
    "identification": "issuer value name?",
    "calibrationLaboratory": "contact",
    "respPersons": "respPerson+",
    "respPerson": "person role? mainSigner?",
    **dict.fromkeys(("contact", "customer"), CONTACT.replace("location?", "location")),
    **dict.fromkeys(("person", "manufacturer"), CONTACT),
    "measurementResults": "measurementResult+",
    "measurementResult": "name usedMethods? usedSoftware? measuringEquipments? "
    "influenceConditions? results measurementMetaData?",
    "influenceConditions": "influenceCondition+",
    "influenceCondition": "name data",
    "usedMethods": "usedMethod+",
    "usedMethod": "name norm*",
    "measuringEquipments": "measuringEquipment+",
    "measuringEquipment": "name description? manufacturer? model? identifications?",
    "results": "result+",
    "result": "name data",
    "data": "quantity+",
    "quantity": "name noQuantity? real? realListXMLList?",
    "realListXMLList": "labelXMLList valueXMLList unitXMLList "
    "measurementUncertaintyMultivariateXMLList",
    "measurementUncertaintyMultivariateXMLList": "ellipsoidalRegionMUXMLList",
    "ellipsoidalRegionMUXMLList": "covarianceMatrixXMLList coverageFactorXMLList "
    "coverageProbabilityXMLList",
    "covarianceMatrixXMLList": "columnXMLList+",
    "columnXMLList": "covarianceXMLList",
    "covarianceXMLList": "valueXMLList unitXMLList",
    "real": "value unit measurementUncertaintyUnivariate?",
    "measurementUncertaintyUnivariate": "expandedMU",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability",
    "measurementMetaData": "metaData+",
    "metaData": "name norm* declaration? conformity?",
    **dict.fromkeys(("name", "description", "declaration", "noQuantity"), "content+"),
}
"""Children of each element that is written, in the order of the schema."""

TEXT = r"\S+(\s+\S+)*"
NUMBER = r"[-+]?\d+(\.\d+)?([eE][-+]?\d+)?"
DATE = r"\d{4}-\d\d-\d\d"
VALUES = {
    **dict.fromkeys(("release", "uniqueIdentifier", "norm", "model", "city", "street"), TEXT),
    **dict.fromkeys(("postCode", "role", "eMail"), TEXT),
    **dict.fromkeys(("countryCodeISO3166_1", "countryCode"), "[A-Z]{2}"),
    **dict.fromkeys(("usedLangCodeISO639_1", "mandatoryLangCodeISO639_1"), "[a-z]{2}"),
    **dict.fromkeys(("beginPerformanceDate", "endPerformanceDate", "issueDate"), DATE),
    "performanceLocation": "laboratory|customer|laboratoryBranch|customerBranch|other",
    "issuer": "manufacturer|calibrationLaboratory|customer|owner|other",
    "mainSigner": "true|false",
    "unit": r"\\metre|\\radian|\\one|\\degreecelsius|\\percent|\\kelvin|\\hecto\\pascal",
    **dict.fromkeys(("valueExpandedMU", "coverageFactor"), NUMBER.removeprefix("[-+]?")),
    "coverageProbability": r"0(\.\d+)?|1(\.0+)?",
    "conformity": "pass|fail|conditionalPass|conditionalFail|noPass|noFail",
}
"""What the text of an element without children must match, as in the schema; `value` is text in an
identification and a number in a quantity.
"""
ATTRIBUTES = {"digitalCalibrationCertificate": {"schemaVersion", "schemaLocation"}}
"""Attributes that are written; no other element has any."""

HOSTILE = '<script>alert("1")</script> & ]]> \N{SNOWMAN}'


NAMES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}


def read_text(element: ElementTree.Element, path: str) -> str:
    """Return the text of the first element of a path."""
    text = element.findtext(path, namespaces=NAMES)
    assert text is not None, path
    return text


def check_rules(element: ElementTree.Element) -> None:
    """Assert that an element and all below it follow the rules."""
    tag = element.tag.rpartition("}")[2]
    names = {name.rpartition("}")[2] for name in element.attrib}
    assert names == ATTRIBUTES.get(tag, set()), tag
    children = [child.tag.rpartition("}")[2] for child in element]
    if tag == "location":
        assert children
        return
    if tag not in RULES:
        assert not children, tag
        check_value(tag, element.text or "")
        return
    left = list(children)
    for rule in RULES[tag].split():
        name, sign = (rule[:-1], rule[-1]) if rule[-1] in "?+*" else (rule, "")
        count = 0
        while left and left[0] == name and (count == 0 or sign in "+*"):
            left.pop(0)
            count += 1
        assert count or sign in ("?", "*"), (tag, name, children)
    assert left == [], (tag, children)
    for child in element:
        check_rules(child)
    for child in (element.find("dcc:value", NAMES), element.find("si:value", NAMES)):
        if child is not None:
            rule = NUMBER if tag == "real" else TEXT
            assert re.fullmatch(rule, child.text or ""), (tag, child.text)


def check_value(tag: str, text: str) -> None:
    """Assert that the text of an element without children is one that the schema allows."""
    assert text.strip(), tag
    if tag in VALUES:
        assert re.fullmatch(VALUES[tag], text), (tag, text)


@pytest.fixture(scope="module")
def run(tmp_path_factory, robot, data):  # noqa: F811
    """Return the folder of a run with an instrument and a limit."""
    measured = with_instrument(data, FACTS | {"laboratory": HOSTILE})
    volume = {"x": (-0.01, 0.01)}
    options = lc.CalibrationOptions(hold_out=0.25, limit_position=1e-3, volume=volume)
    path = tmp_path_factory.mktemp("certificate") / "run"
    return lc.save_run(lc.calibrate(robot, measured, options), path)


def write_facts(folder, name="A", **changed):
    """Write administrative data, filled in, with some lines changed."""
    text = read_template().replace('name: ""', f"name: {json.dumps(name)}")
    filled = {"serial_number": '"0017"', "number": '"2026-001"', "country": "DE"}
    filled |= dict.fromkeys(("begin", "end", "issued"), "2026-01-31")
    filled |= {"operator": "B", "value": "20.4 degC", "plus_minus": "0.6 K"}
    for key, value in filled.items():
        text = text.replace(f'{key}: ""', f"{key}: {value}")
    for old, new in changed.values():
        assert old in text
        text = text.replace(old, new)
    (folder / "facts.yaml").write_text(text, "utf-8")
    return folder / "facts.yaml"


def test_a_changed_run_has_no_certificate(tmp_path, run) -> None:
    shutil.copytree(run, tmp_path / "run")
    path = tmp_path / "run" / "result.json"
    content = json.loads(path.read_text("utf-8"))
    for findings in ([7], ["a text"], []):
        assert content["findings"] != findings
        path.write_text(json.dumps({**content, "findings": findings}), "utf-8")
        with pytest.raises(FileError, match="has changed since the calibration"):
            format_certificate(lc.load_run(path.parent), load_administration(write_facts(tmp_path)))


def test_certificate_follows_the_schema_and_states_the_run(tmp_path, run) -> None:
    text = format_certificate(lc.load_run(run), load_administration(write_facts(tmp_path, HOSTILE)))
    root = ElementTree.fromstring(text)
    check_rules(root)
    assert root.get("schemaVersion") == "3.3.0"
    assert read_text(root, ".//dcc:item/dcc:name/dcc:content") == HOSTILE
    assert HOSTILE in read_text(root, ".//dcc:measuringEquipment/dcc:description/*")
    assert "<script>" not in text
    numbers = [e.text for e in root.findall(".//dcc:identification/dcc:value", NAMES)]
    assert numbers == ["0017", "0750123", "D-K-15123-01"]
    roles = [e.text for e in root.findall(".//dcc:respPerson/dcc:role", NAMES)]
    assert roles[-1] == "operator"
    conditions = root.findall(".//dcc:influenceCondition//si:value", NAMES)
    assert [e.text for e in conditions] == ["20.4", "20.4"]
    rows = json.loads((run / "result.json").read_text("utf-8"))["fit"]["parameters"]
    factor = {"mm": 1e-3, "deg": math.pi / 180.0}
    quantities = root.findall(".//dcc:result//dcc:quantity", NAMES)
    for row, quantity in zip(rows, quantities, strict=False):
        assert read_text(quantity, "dcc:name/dcc:content") == row["name"]
        half = row["plus_minus"] * factor[row["unit"]]
        digits = read_text(quantity, ".//si:valueExpandedMU")
        assert len(digits.replace(".", "").lstrip("0")) == 2  # JCGM 100, 7.2.6
        assert float(digits) == pytest.approx(half, rel=0.05)
        value = float(read_text(quantity, "si:real/si:value"))
        assert value == pytest.approx(row["estimate"] * factor[row["unit"]], abs=0.05 * half)
        unit = r"\metre" if row["unit"] == "mm" else r"\radian"
        assert read_text(quantity, "si:real/si:unit") == unit
    assert read_text(root, ".//dcc:metaData/dcc:conformity") == "pass"
    declared = [e.text or "" for e in root.findall(".//dcc:declaration/dcc:content", NAMES)]
    verdict, volume, limit, limit_of_volume = declared
    content = json.loads((run / "result.json").read_text("utf-8"))
    assert verdict.startswith(content["headline"])
    assert content["expected_error"]["finding"]["text"] in verdict
    assert "do not cover influences outside" in verdict
    warnings = [f["text"] for f in content["findings"] if f["severity"] == "warning"]
    assert all(text in verdict for text in warnings)
    (judged,) = [f for f in content["findings"] if not f["data"].get("is_volume", True)]
    assert limit.startswith(judged["text"])
    assert content["fit"]["interval_note"] in verdict
    stated = content["volume"]
    assert volume == " ".join(f["text"] for f in stated["findings"][:2])  # bound and conditions
    assert limit_of_volume in [f["text"] for f in stated["findings"]]
    bounds = {read_text(q, "dcc:name/dcc:content"): q for q in quantities}
    for name in ("simultaneous", "pointwise"):
        (bound,) = (q for words, q in bounds.items() if f", {name}" in words)
        shown = float(read_text(bound, "si:real/si:value"))
        assert shown == pytest.approx(stated[name], rel=0.005)  # three digits
    columns = root.findall(".//si:columnXMLList/*/si:valueXMLList", NAMES)
    covariance = np.array([(e.text or "").split() for e in columns], float)
    assert covariance == pytest.approx(lc.load_run(run).arrays["covariance"], rel=1e-9)
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()  # rounding left it a covariance


@pytest.mark.evidence  # the schema of PTB must not be copied into this repository
@pytest.mark.skipif(
    not os.environ.get("LOOPCAL_DCC_SCHEMA"),
    reason="LOOPCAL_DCC_SCHEMA names a folder with dcc.xsd 3.3.0 and SI_Format.xsd 2.2 of PTB: "
    "lib/dcc/schema/resources of the public repository lutaml/dcc has both (passed 2026-11-30)",
)
def test_certificate_is_valid_by_the_schema_of_ptb(tmp_path, run) -> None:
    xmlschema = pytest.importorskip("xmlschema")
    folder = Path(os.environ["LOOPCAL_DCC_SCHEMA"]).resolve()
    signature = Path(xmlschema.__file__).parent / "schemas" / "DSIG" / "xmldsig-core-schema.xsd"
    kinds = tmp_path / "kinds.xsd"  # of quantities, which a certificate does not name
    kinds.write_text(
        '<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="http://qudt.org/'
        'vocab/"><xs:simpleType name="quantitykind"><xs:restriction base="xs:string"/>'
        "</xs:simpleType></xs:schema>",
        "utf-8",
    )
    files = [kinds, folder / "SI_Format.xsd", folder / "dcc.xsd"]
    schema = xmlschema.XMLSchema([*map(str, [signature, *files])], allow="local")
    facts = load_administration(write_facts(tmp_path))
    text = format_certificate(lc.load_run(run), facts)
    assert [str(e) for e in schema.iter_errors(text)] == []
    for right, wrong in (("<si:unit>", "<si:unit/><si:unit>"), ("3.3.0", "3.2.0")):
        assert not schema.is_valid(text.replace(right, wrong, 1))


def test_rules_refuse_what_the_schema_refuses(tmp_path, run) -> None:
    certificate = format_certificate(lc.load_run(run), load_administration(write_facts(tmp_path)))
    for element, text in (
        (".//dcc:uniqueIdentifier", " 2026"),
        (".//dcc:coreData/dcc:issueDate", "31.01.2026"),
        (".//dcc:coreData/dcc:usedLangCodeISO639_1", "EN"),
        (".//si:real/si:value", "inf"),
        (".//si:valueExpandedMU", "-1.0"),
        (".//si:coverageProbability", "95"),
        (".//dcc:metaData/dcc:conformity", "passed"),
        (".//dcc:identification/dcc:issuer", "loopcal"),
    ):
        root = ElementTree.fromstring(certificate)
        changed = root.find(element, NAMES)
        assert changed is not None
        changed.text = text
        with pytest.raises(AssertionError):
            check_rules(root)


def test_characters_that_xml_cannot_hold_become_visible(tmp_path, run) -> None:
    facts = write_facts(tmp_path, "a\u0001b\ufffec")
    try:
        text = format_certificate(lc.load_run(run), load_administration(facts))
    except FileError:  # the file is refused
        return
    name = read_text(ElementTree.fromstring(text), ".//dcc:item/dcc:name/dcc:content")
    assert "\u0001" not in name
    assert name.startswith("a")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("country: DE   ", "country: Germany"), r"'country' is 'Germany'. Write two capital"),
        (("value: 20.4 degC", "value: 20.4 C"), r"value' is '20.4 C'. Write a number and its unit"),
        (("begin: 2026-01-31", "begin: 2026-02-31"), "date|day is out of range|valid YAML"),
        (("end: 2026-01-31", "end: 2025-01-31"), r"'end' is 2025-01-31, before begin"),
        (("place: laboratory ", "place: cellar "), "'place' is 'cellar'.*Allowed"),
        (('serial_number: "0017"', 'serial_number: ""'), r"facts.yaml:10: .*serial_number"),
        (("machine:", "robot:"), "unknown key 'robot'"),
    ],
)
def test_wrong_facts_are_refused_at_their_line(tmp_path, change, message) -> None:
    with pytest.raises(FileError, match=message):
        load_administration(write_facts(tmp_path, change=change))


def test_template_must_be_filled_in(tmp_path) -> None:
    (tmp_path / "facts.yaml").write_text(read_template(), "utf-8")
    with pytest.raises(FileError, match=r"facts.yaml:3: .* number, country, begin, end, mach"):
        load_administration(tmp_path / "facts.yaml")
    rows = load_administration(tmp_path / "facts.yaml", is_complete=False).list_rows()
    assert not any(rows.values())  # a report leaves lines to fill in by hand


def test_robot_files_have_no_certificate(tmp_path, robot) -> None:  # noqa: F811
    lc.save_robot(robot, tmp_path / "robot.yaml")
    facts = load_administration(write_facts(tmp_path))
    run = load_run_or_robot(tmp_path / "robot.yaml")
    with pytest.raises(DataError, match=r"has no result. Give a run folder"):
        format_certificate(run, facts)


def test_commands_print_facts_and_certificate(tmp_path, run, capsys) -> None:
    assert main(["new", "--report-facts", str(tmp_path / "new.yaml")]) == 0
    assert (tmp_path / "new.yaml").read_text("utf-8") == read_template()
    capsys.readouterr()
    facts = str(write_facts(tmp_path))
    assert main(["certificate", str(run), facts]) == 0
    check_rules(ElementTree.fromstring(capsys.readouterr().out.encode()))
    assert main(["certificate", str(run), facts, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["certificate"].startswith("<?xml")
    assert main(["certificate", str(run)]) == 1
    assert main(["new", "five-bar"]) == 1
    assert "FAMILY and -o" in capsys.readouterr().err


def test_results_are_in_english_whatever_the_language_of_the_facts(tmp_path, run) -> None:
    facts = write_facts(tmp_path)
    facts.write_text(re.sub("(?m)^language: .*", "language: de", facts.read_text("utf-8")))
    text = format_certificate(lc.load_run(run), load_administration(facts))
    root = ElementTree.fromstring(text)
    check_rules(root)
    used = root.findall(".//dcc:coreData/dcc:usedLangCodeISO639_1", NAMES)
    assert [code.text for code in used] == ["en", "de"]
    assert read_text(root, ".//dcc:coreData/dcc:mandatoryLangCodeISO639_1") == "en"


@pytest.mark.parametrize(("degrees", "factor"), [(np.inf, 2.45), (10.0, 2.86)])
def test_region_of_parameters_counts_the_degrees_of_freedom(degrees, factor) -> None:
    """JCGM 102, 6.5: sqrt(2 F) of 2 and 10 degrees, sqrt(chi-square) of known noise."""
    parameters = [
        {"name": name, "si:real": {"si:value": "1", "si:unit": r"\metre"}} for name in "ab"
    ]
    (region,) = certificate._describe_covariance(np.eye(2), parameters, degrees)
    stated = region["si:realListXMLList"]["si:measurementUncertaintyMultivariateXMLList"]
    assert stated["si:ellipsoidalRegionMUXMLList"]["si:coverageFactorXMLList"] == str(factor)
