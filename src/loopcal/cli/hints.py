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
}
"""Code -> hint, printed in parentheses after the sentence."""
