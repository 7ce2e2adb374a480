# SPDX-License-Identifier: Apache-2.0
"""Options of the command line that help with an error, by the code of its finding."""

from __future__ import annotations

HINTS: dict[str, str] = {
    "files.output-exists": "--force replaces it",
    "files.folder-in-use": "--force replaces it",
    "validation.file-reused": "--allow-fitted-data accepts it",
    "validation.rows-reused": "--allow-fitted-data accepts them",
    "files.noise-missing": "calibrate with --noise estimated",
    "files.surfaces-in-plan": "use --measure plane-line",
    "plan.goal-missed": "--hold-out, --criterion I",
    "plan.goal-unreachable": "--candidates draws more poses, --accuracy states the goal",
    "plan.groups-excluded": "--points, or one of --min-margin and --max-tilt",
    "plan.home-excluded": "--min-margin, --max-tilt",
    "plan.home-isolated": "--min-margin, --max-tilt",
    "plan.listed-poses-excluded": "--allowed lists the poses",
    "plan.measured-empty": "--measured names the file",
    "plan.nothing-observable": "--kind, or --like with a measurement file",
    "plan.points-isolated": "--seed, or one of --min-margin and --max-tilt",
    "plan.target-unobservable": "--accuracy takes a length or an angle",
    "plan.too-few-candidates": "--poses, --hold-out, --candidates",
    "plan.too-few-equations": "--poses",
    "plan.too-few-groups": "--groups, --points",
    "plan.too-few-held-out": "--hold-out, --candidates",
    "plan.workspace-excluded": "--min-margin, --max-tilt, --seen-from",
}
"""Code -> hint, printed in parentheses after the sentence."""
