# SPDX-License-Identifier: Apache-2.0
"""Values for controllers, where the result comes from, and the poses that it uses."""

from __future__ import annotations

from collections.abc import Sequence

from loopcal.report.document.elements import Code, Element, Listing, Section
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.document.stored_options import describe_call, list_options
from loopcal.report.tables import Table, word_column
from loopcal.workflow import Verdict

LINES = 40
"""Lines of a controller's file that the report shows."""

MOST = 3000
"""Labels of poses that the report lists."""

EVERYWHERE = (
    "The command loopcal export writes the parameters to a file: of every robot as csv or json, "
    "and in the formats of controllers that can express it."
)
NO_CONTROLLER = "No format of a controller that loopcal writes can express this robot."
FAILED = "The calibration failed, so the report states no values for a controller."


def build_controller_section(record: CalibrationRecord) -> Section:
    """Return what to write into which controller."""
    title = "Values for the controller"
    if record.verdict is Verdict.NOT_CALIBRATED:
        return Section("controller", title, (FAILED,))
    elements: list[Element] = [] if record.controllers else [NO_CONTROLLER]
    for values in record.controllers:
        lines = values.text.strip("\n").splitlines()
        if len(lines) <= LINES:
            elements.append(Code(f"{values.format}: {values.what}", "\n".join(lines)))
        else:
            sentence = (
                f"{values.format} ({values.what}): {len(lines)} lines, too many for this page"
            )
            elements.append(f"{sentence}; the command loopcal export writes them to a file.")
        if values.notes:
            elements.append(Listing(tuple(("note", note) for note in values.notes)))
    return Section("controller", title, (*elements, EVERYWHERE))


def build_provenance_section(record: CalibrationRecord) -> Section:
    """Return command, versions, seeds, options and digests of the files."""
    made_by = record.result.get("made_by") or {}
    command = " ".join(made_by.get("command") or ()) or "called from Python"
    rows = [
        ("command", command),
        *((_label_version(name), value) for name, value in made_by.get("versions", {}).items()),
        *((f"seed: {name}", str(seed)) for name, seed in made_by.get("seeds", {}).items()),
        ("method", describe_call(str(record.result["fit"].get("method") or "unknown"))),
        *list_options(str(record.result.get("options") or "")),
    ]
    files = [
        *((f"input: {i}", f["path"], f["sha256"]) for i, f in made_by.get("inputs", {}).items()),
        *(("result", name, digest) for name, digest in record.result.get("files", {}).items()),
    ]
    columns = (word_column("item"), word_column("value", wraps=True))
    elements: list[Element] = [Table("Origin of this result", columns, tuple(rows))]
    if files:
        columns = (
            word_column("role"),
            word_column("file", wraps=True),
            word_column("SHA-256", wraps=True),
        )
        elements.append(Table("Files and their digests", columns, tuple(files)))
    return Section("provenance", "Provenance", tuple(elements))


def _label_version(name: str) -> str:
    """Return the label of an entry of `versions`; that of the engine states its name, too."""
    return name if name == "engine" else f"version of {name}"


def build_pose_section(record: CalibrationRecord) -> Section:
    """Return the labels of the fitted and held-out poses."""
    elements: list[Element] = []
    fitted = record.fitted_labels
    if fitted:
        elements.append(_list_labels("fitted", fitted))
    else:
        elements.append(
            "This run folder was written by an earlier version and does not name its fitted poses."
        )
    if record.held_out_labels:
        elements.append(_list_labels("held-out", record.held_out_labels))
    else:
        elements.append("No pose was held out.")
    return Section("poses", "Fitted and held-out poses", tuple(elements))


def _list_labels(what: str, labels: Sequence[str]) -> str:
    """Return the labels in one sentence; of many the first."""
    count = len(labels)
    noun = "pose" if count == 1 else "poses"
    limit = f", of which the first {MOST:,} are listed" if count > MOST else ""
    return f"{count:,} {what} {noun}{limit}: {', '.join(labels[:MOST])}."
