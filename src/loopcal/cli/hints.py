# SPDX-License-Identifier: Apache-2.0
"""From the code of a finding or an error to the command-line option that helps.

Messages of the library do not know the command line. `main` and the views add these hints. A hint
that names an option is only for commands that have the option.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from loopcal.findings import Finding

HINTS = {
    "data.duplicate-rows": "use --allow-duplicates to accept them",
    "data.held-out-twice": "leave out --hold-out",
    "data.outside-stroke": "use --allow-outside-stroke to accept it",
    "conventions.other-interpretation": "use --allow-implausible to accept the data as written",
    "conventions.stated-values-contradicted": "use --allow-implausible to accept the statement",
    "conventions.strokes-contradicted": "use --allow-outside-stroke to accept them",
    "conventions.strokes-explained": "use --allow-outside-stroke to accept them",
    "conventions.target-never-moves": "use --allow-still to accept it",
    "outliers.some": "use --drop POSE, or --loss huber",
    "residuals.heavy-tailed": "use --loss huber",
    "files.output-exists": "use --force to replace it",
    "files.folder-in-use": "use --force to replace it",
    "files.groups-in-plan": "use --kind and the sigmas instead of --like",
    "files.strut-length": "use --format linuxcnc-ini --into machine.ini",
    "files.ini-needed": "use --into machine.ini",
    "files.format-unknown": "use --format NAME",
    "files.format-takes-no-file": "leave out --into",
    "files.no-measurements": "leave out --data and --corrected",
    "files.unit-missing": "use --unit mm or --unit in",
    "files.home-assumed": "use --home-z",
    "files.closures-missing": "use --closures loops.yaml",
    "files.platform-unknown": "use --platform LINK",
    "files.platform-unclear": "use --platform LINK",
    "files.limb-branches": "use --platform LINK",
    "files.motors-outside": "use --platform LINK",
    "files.no-limbs": "use --platform LINK",
    "files.urdf-needed": "use --into robot.urdf",
    "files.robot-of-program": "type loopcal import FILE -o printer.yaml --data heights.csv (for "
    "Marlin and RepRapFirmware with --probes REPORT), then loopcal calibrate printer.yaml "
    "heights.csv -o run",
    "files.g32-no-points": "use --probes bed.g beside the report",
    "files.probes-imported": "state another noise by --sigma-height",
    "files.saved-block": "use --into printer.cfg",
    "files.probe-noise-assumed": "state other values by --sigma-height and --sigma-distance",
    "files.sample-noise-assumed": "state other values by --sigma-line and --sigma-position",
    "files.taped-prior": "state another value by --sigma-tape",
    "sheet.points-unit": "use --unit",
    "sheet.no-name-matches": "use --by-order",
    "sheet.points-misnamed": "use --allow-implausible to accept them",
    "files.surfaces-in-plan": "use --measure plane-line",
    "fit.beyond-tolerance": "use --method map",
    "fit.low-weights": "exclude a pose with --drop POSE",
    "fit.no-prior": "use --method map",
    "identifiability.arbitrary-cut": "use --useful, such as --useful 1um",
    "fit.too-few-equations": "use --method map",
    "noise.assumed": "type loopcal import FILE with --sigma-height LENGTH, or write the noise in "
    "the file",
    "gates.correction-not-written": "use --force to write it nevertheless",
    "gates.run-not-calibrated": "use --force to write them nevertheless",
    "gates.run-without-verdict": "use --force to write its numbers nevertheless",
    "noise.residuals-too-large": "use --verbose for all findings",
    "noise.residuals-too-small": "use --noise estimated",
    "noise.few-degrees": "use --noise given",
    "prior.machine-changed": "use --free-limb LIMB",
    "prior.rows-reused": "exclude poses with --drop POSE",
    "prior.tolerances-too-narrow": "use --method auto",
    "plan.frame-unbounded": "use --frame fitted",
    "plan.goal-missed": "use a smaller --hold-out, or --criterion I",
    "plan.goal-unreachable": "draw more poses with --candidates, or relax --accuracy",
    "plan.groups-excluded": "use fewer --points, or relax --min-margin or --max-tilt",
    "plan.home-excluded": "relax --min-margin or --max-tilt",
    "plan.home-isolated": "relax --min-margin or --max-tilt",
    "plan.listed-poses-excluded": "--allowed lists the poses",
    "plan.measured-empty": "--measured names the file",
    "plan.nothing-observable": "choose another --kind, or use --like with a measurement file",
    "plan.points-isolated": "use another --seed, or relax --min-margin or --max-tilt",
    "plan.target-unobservable": "give --accuracy as a length or as an angle",
    "plan.too-few-candidates": "use fewer --poses or --hold-out, or more --candidates",
    "plan.too-few-equations": "use more --poses",
    "plan.few-groups": "use more --groups or --points; calibrate by a method with a prior",
    "plan.too-few-held-out": "use a smaller --hold-out, or more --candidates",
    "plan.weak-certificate": "use another --seed, or more --poses",
    "plan.workspace-excluded": "relax --min-margin, --max-tilt or --seen-from",
    "store.in-use": "use --resume to continue it",
    "store.disk-full": "use --resume to continue",
    "workers.cluster-lost": "use --resume to continue",
    "workflow.limit-needs-held-out-poses": "add --hold-out 0.25",
    "workflow.next-hold-out": "use --hold-out 0.25, or loopcal validate RUN OTHER-DATA",
    "workflow.next-hold-out-more": "use a larger --hold-out, or loopcal validate RUN OTHER-DATA",
    "workflow.next-check-height-sign": "loopcal import reads the heights of a firmware with their "
    "sign",
    "workflow.next-state-noise": "use --noise estimated, or state noise in the measurement file",
    "workflow.no-held-out-poses": "use --hold-out 0.25",
    "workflow.undetermined-combinations": "see loopcal identifiability ROBOT DATA",
    "workflow.few-held-out-poses": "use a larger --hold-out, or the column 'use'",
    "workflow.held-out-setup": "choose them with the column 'use'",
    "workflow.free-limb-needs-prior": "add --prior RUN",
    "workflow.option-excludes-prior": "leave out --method, --loss and --choose-model",
    "workflow.too-few-equations": "use --method map to let the tolerances decide",
    "workflow.no-parameter-chosen": "leave out --choose-model",
    "workflow.next-check-outliers": "exclude a pose with --drop POSE, or use --loss huber",
    "workflow.next-check-noise": "use --noise estimated, or --verbose for all findings",
    "workflow.next-check-residuals": "use --verbose for all findings",
    "workflow.next-check-data": "see loopcal identifiability ROBOT DATA",
    "workflow.next-measure-more": "use --choose-model to free fewer parameters, or loopcal plan",
    "workflow.next-resolve-warnings": "use --verbose for all findings, loopcal validate for other "
    "data",
    "workflow.next-check-held-out": "exclude a pose with --drop POSE",
    "compensation.not-converged": "use more --steps, or --mode readings",
    "validation.rows-reused": "use --allow-fitted-data to accept them",
    "validation.setup-moved": "use --refit NAME",
}
"""Code -> advice, in the imperative."""

OPTION = re.compile(r"--[a-z][a-z-]*")
"""An option in a hint."""


def find_hint(code: str | None, command: click.Command | None) -> str | None:
    """Return the hint for a code; None where there is none, or where this command, if it is known,
    lacks an option in it. What follows the word `type` is another command.
    """
    hint = None if code is None else HINTS.get(code)
    if hint is None or command is None or hint.startswith("type loopcal "):
        return hint
    options = {name for parameter in command.params for name in parameter.opts}
    return hint if options.issuperset(OPTION.findall(hint)) else None


def hint_for(finding: Finding) -> str | None:
    """Return the hint for a finding, with the names it contains, for the command that runs."""
    context = click.get_current_context(silent=True)
    command = None if context is None else context.command
    return word_hint(finding, find_hint(finding.code, command))


def word_hint(finding: Finding, hint: str | None) -> str | None:
    """Return a hint with the names that its finding contains; None where it does not help."""
    from loopcal.findings.catalog.phrases import MACHINE

    code, data = finding.code, finding.data
    is_useless = (
        (code in ("files.limb-branches", "files.no-limbs") and not data["platforms"])
        or (code == "prior.rows-reused" and not data["others"])  # no row would be left
        or (code == "prior.machine-changed" and data["subject"] != MACHINE)  # free already
    )
    if hint is None or is_useless:
        return None
    links = data.get("links") or data.get("platforms")
    if "--platform LINK" in hint and links:
        return hint.replace("--platform LINK", name_options("--platform", links[:1]))
    if code == "workflow.next-check-outliers":
        poses = [str(label).removeprefix("pose ") for label in data["poses"]]
        return f"use {name_options('--drop', poses)}, or --loss huber"
    if code == "validation.setup-moved":
        return f"use {name_options('--refit', data['names'])}"
    return hint


def name_options(option: str, values: Iterable[str]) -> str:
    """Return an option with each of these values, to copy: a shell reads them as they are."""
    return " ".join(f"{option} {shlex.quote(value)}" for value in values)


def with_hint(finding: Finding) -> str:
    """Return the text of a finding, with the hint for the command that runs."""
    from loopcal.findings.wording import add_advice

    return add_advice(finding, hint_for(finding))


def list_hints(findings: Iterable[Finding]) -> list[str]:
    """Return the lines of the hints for findings."""
    return [f"Hint: {hint}" for finding in findings if (hint := hint_for(finding))]
