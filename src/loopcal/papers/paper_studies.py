# SPDX-License-Identifier: Apache-2.0
"""The study files of the papers: read for `reproduce`, and written for users, whose robot may
replace that of the paper.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from loopcal.errors import DataError
from loopcal.io.core.outputs import restore_on_failure
from loopcal.io.core.text_file import write_text
from loopcal.papers import Paper
from loopcal.studies.files.study_file import load_study, quote_robot
from loopcal.studies.specification.study import Study

FILE = "study.yaml"
"""Name of the study file in the folder of a paper with one robot."""

ANY_ERRORS = "errors: [1]  # normal errors, in tolerances of the robot file"
"""In place of errors that are those of one robot."""


def load_paper_study(module: str, name: str = FILE) -> Study:
    """Return a study of the paper in whose folder the file `module` is."""
    return load_study(Path(module).with_name(name))


@dataclass(frozen=True)
class PaperStudyFile:
    """A study file to write, and the poses beside it.

    Attributes
    ----------
    path, text : of the study file. poses, poses_text : of the file of poses beside it; None and ""
        without one. robot : that the study names. replaced : keys of the study that belonged to the
        robot of the paper and were replaced, too.
    """

    path: Path
    text: str
    poses: Path | None
    poses_text: str
    robot: str
    replaced: tuple[str, ...]

    @property
    def outputs(self) -> tuple[Path, ...]:
        """Files that are written."""
        return (self.path,) if self.poses is None else (self.path, self.poses)

    def write(self) -> None:
        """Write the files; FileError where that is impossible."""
        with restore_on_failure(self.outputs):
            if self.poses is not None:
                write_text(self.poses, self.poses_text)
            write_text(self.path, self.text)


def make_paper_study(paper: Paper, path: Path, robot: str | None = None) -> PaperStudyFile:
    """Return the study file of a paper, for its robot or for another one.

    Another robot gets as many poses of its own workspace in place of a file of poses, and errors by
    its tolerances in place of the errors of one machine.

    Raises
    ------
    FileError : there is no such robot. DataError : the paper has no study file.
    """
    if not paper.studies:
        raise DataError(f"{paper.name} has no study file")
    wanted = next(iter(paper.studies)) if robot is None else robot
    is_own = wanted in paper.studies
    folder = files(paper.module.rpartition(".")[0])
    source = paper.studies[wanted] if is_own else next(iter(paper.studies.values()))
    text = (folder / source).read_text("utf-8")
    poses_match = re.search(r"^  .*\{file: (?P<name>[\w.]+)\}$", text, re.MULTILINE)
    poses_text = "" if poses_match is None else (folder / poses_match["name"]).read_text("utf-8")
    if is_own:
        if poses_match is None:
            return PaperStudyFile(path, text, None, "", wanted, ())
        poses = path.with_name(f"{path.stem}-poses.csv")
        text = text.replace(
            f"{{file: {poses_match['name']}}}", f"{{file: {quote_name(poses.name)}}}"
        )
        return PaperStudyFile(path, text, poses, poses_text, wanted, ())
    replaced = []
    text = replace_key(text, "robots", f"robots: [{quote_robot(path, wanted)}]")
    if poses_match is not None:
        count = len(poses_text.splitlines()) - 1
        text = replace_key(text, "poses", f"poses: [{count}]  # drawn from the workspace")
        replaced.append("poses")
    if re.search(r"^ +deviations:", text, re.MULTILINE):
        text = replace_key(text, "errors", ANY_ERRORS)
        replaced.append("errors")
    return PaperStudyFile(path, text, None, "", wanted, tuple(replaced))


def quote_name(name: str) -> str:
    """Return the name of a file as a YAML text within braces."""
    return name if re.fullmatch(r"[\w.-]+", name) else '"' + name.replace('"', '\\"') + '"'


def replace_key(text: str, key: str, content: str) -> str:
    """Return the text of a study file in which one key, with the comment above it, is replaced."""
    pattern = rf"(?:^#[^\n]*\n)*^{key}:[^\n]*\n(?:^[ ][^\n]*\n)*"
    changed, count = re.subn(pattern, lambda _: f"{content}\n", text, flags=re.MULTILINE)
    assert count == 1, key
    return changed
