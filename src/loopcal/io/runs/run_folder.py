# SPDX-License-Identifier: Apache-2.0
"""Run folders of calibrations: the report with its numbers, arrays, robot file and provenance.

result.json    `CalibrationReport.to_dict()`: `fit`, `start`, `split`, `validation` and more, under
               `made_by` its provenance (see MADE_BY), and under `files` the SHA-256 of the other
               files; parameters in the units of the robot file, the rest in SI; a number that is
               not finite is null, with the reason under `nulls`
arrays.npz     `Identification.arrays()`, `initial` (values of all parameters before the
               calibration) and the fitted rows, by name, SI (no pickles)
robot.yaml     the corrected robot file: the nominal file plus its `identified:` table; of a
               calibration that failed it is called robot-not-calibrated.yaml (`run_verdict`)

loopcal reads back what STATED and FORMS declare. A run states far more than this: other keys are
for people and other programs, and are not checked.
"""

from __future__ import annotations

import json
import math
import os
import re
import struct
import tokenize
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, make_dataclass, replace
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from loopcal.engine import collect_versions
from loopcal.errors import DataError, EstimationError, FileError
from loopcal.estimate.free_parameters import free_only
from loopcal.estimate.options import FitOptions
from loopcal.estimate.posterior import Posterior, posterior_from_arrays
from loopcal.estimate.residual_test import NoiseKnowledge
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.io.core import outputs
from loopcal.io.core.limits import ARRAYS_COUNT, ARRAYS_SIZE, TABLE_SIZE, FileLimit
from loopcal.io.core.records import read_record
from loopcal.io.core.text_file import as_path, open_bytes, read_json, sha256
from loopcal.io.core.yaml_file import YamlFile, read_yaml
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import (
    NOT_CALIBRATED,
    format_robot,
    list_shipped_robots,
    load_robot,
    remove_mark,
)
from loopcal.measure.fitted_rows import FittedRows, fitted_rows_from_arrays
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.results.result import Result
from loopcal.results.serialization import json_fields
from loopcal.typing import Progress, report_no_progress
from loopcal.units import UNITS

if TYPE_CHECKING:
    from loopcal.apply.calibration_report import CalibrationReport
    from loopcal.estimate.fit_linearization import FitUncertainty

RESULT = "result.json"
FORMAT = 2

# Half a character: part of a file name that is not UTF-8.
_SURROGATE = re.compile("[\ud800-\udfff]")


Number = float | None
PARAMETERS: list[Any] = [{"name": str, "plus_minus": Number, "estimate": float, "unit": str}]
SOURCE: dict[str, Any] = {
    "kind": str,
    "name": str,
    "evaluation": str,
    "degrees": Number,
    "stated?": ({"value": float, "unit": str, "distribution": str, "divisor": float, "u": float},),
    "position": Number,
    "orientation": Number,
    "parameters": {"*": Number},
    "halved": ({"position_rms": Number, "orientation_rms": Number, "worst_parameter_sd": Number},),
}
BUDGET: dict[str, Any] = {
    "position": {"rms": Number},
    "orientation": {"rms": Number},
    "parameters": {"*": Number},
    "worst_parameter": str,
    "poses": int,
    "over": str,
    "finding": {"text": str},
    "sources": [SOURCE],
}
CONFORMITY: dict[str, Any] = {
    "decision": Literal["conforms", "does not conform", "neither conforms nor fails"],
    **dict.fromkeys(("estimate", "low", "high", "floor", "bound", "expanded"), float),
    **dict.fromkeys(("limit", "acceptance_limit", "rejection_limit", "guard_band"), float),
    **dict.fromkeys(("probability", "most_probable", "level"), float),
}
VOLUME: dict[str, Any] = {
    "simultaneous": float,
    "pointwise": float,
    "frame": str,
    "findings": [{"code": str, "text": str}],
    "conformity?": (CONFORMITY,),
}
# What loopcal reads back from result.json: types by key, `[of]` for a list, `(of,)` for a value
# that may be null, `*` for any key. A key with a question mark may be absent.
STATED: dict[str, Any] = {
    "format": int,
    "made_by": {"command": [str], "inputs": {"*": {"path": str, "sha256": str}}},
    "fit": {
        "parameters": PARAMETERS,
        "status": str,
        "local": PARAMETERS,  # setup parameters
        "dropped": [str],
        "sigma_scale": Number,
        "noise_degrees": Number,
        "noise": str,
        "p_value": Number,
        "sigma_uncertainty": Number,
    },
    "verdict": Literal["calibrated", "reservations", "not_calibrated", "undecided"],
    "passed": bool,
    "reasons": [str],
    "split": ({"held_out": [str]},),
    "options": {"fit": {"*": Any}},
    "expected_error?": (BUDGET,),
    "volume?": (VOLUME,),
    "validation?": ({"conformity?": {"*": CONFORMITY}},),
    "nulls?": {"*": str},
    "files": {"*": str},
}


def make_type(form: Any) -> Any:
    """Return the type of a form of content; a mapping is a record that ignores other keys."""
    if isinstance(form, list):
        return GenericAlias(tuple, (make_type(form[0]), ...))
    if isinstance(form, tuple):
        return make_type(form[0]) | None
    if not isinstance(form, dict):
        return form
    if "*" in form:
        return GenericAlias(dict, (str, make_type(form["*"])))
    needed = [(key, make_type(of)) for key, of in form.items() if "?" not in key]
    others = [(key.rstrip("?"), make_type(of), None) for key, of in form.items() if "?" in key]
    return make_dataclass("Stated", [*needed, *others], namespace={"OTHER_KEYS": True})


@cache
def get_record() -> Any:
    """Return the record of STATED, which is made where the first result is read."""
    return make_type(STATED)


ROUNDING = 1e-14  # relative difference of an estimate in its unit and in SI
LARGEST = 1e100  # errors and variances of a budget are smaller; their squares are numbers


def read_result(path: Path) -> dict[str, Any]:
    """Return the content of result.json of a run, of which `STATED` is checked; FileError
    where it is no run, of another format, or damaged.
    """
    action = "restore the run folder from a copy, or repeat the calibration"
    content = read_json(path, "run result", f"this file of a run is damaged; {action}", TABLE_SIZE)
    if not isinstance(content, dict):
        raise report_damage(path, "it contains no mapping")
    number = content.get("format")
    if isinstance(number, int) and number != FORMAT:
        sentence = f"this run has format {number}, but this loopcal reads format {FORMAT}"
        raise FileError(f"{sentence}. Calibrate again", path)
    text, plain = json.dumps(content, ensure_ascii=False), content
    if _SURROGATE.search(text):
        plain = json.loads(_SURROGATE.sub("?", text))
    file = YamlFile(path, "", plain)
    stated = read_record(file, plain, get_record(), None, word=report_damage)
    if (budget := stated.expected_error) is None:
        return content
    # errors are sizes, and each table has the worst parameter
    tables = {"expected_error.parameters": budget.parameters}
    numbers = [budget.position.rms, budget.orientation.rms]
    for i, source in enumerate(budget.sources):
        tables[f"expected_error.sources entry {i + 1}.parameters"] = source.parameters
        numbers += [source.position, source.orientation]
        numbers += () if source.halved is None else astuple(source.halved)
    for name, table in tables.items():
        if budget.worst_parameter and budget.worst_parameter not in table:
            problem = f"{name!r} lacks the worst parameter {budget.worst_parameter!r}"
            raise report_damage(path, problem)
        numbers += table.values()
    for wrong in (n for n in numbers if n is not None and not 0.0 <= n < LARGEST):
        problem = f"'expected_error' is {wrong:g}, which is not a size of an error"
        raise report_damage(path, problem)
    return content


def report_damage(path: Path, problem: str) -> FileError:
    """Return the error of a file of a run that is damaged; `problem` says how."""
    return FileError.of("files.run-damaged", path, problem=problem)


# The arrays of a run folder: an archive of NumPy's, read without trust in what it says of itself.

WHAT = "archive of arrays"
KINDS = "biufU"  # kinds of NumPy's types that a run contains: truth values, numbers and text
# What Python's and NumPy's readers raise about damaged archives, in addition to ValueError.
FAULTS = (
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    SyntaxError,
    tokenize.TokenError,
)

# The last record of an archive, with its signature, members and bytes of the directory.
END = struct.Struct("<4s4H2LH")


def read_arrays(path: Path, size: FileLimit = ARRAYS_SIZE) -> dict[str, np.ndarray]:
    """Return name -> array, read-only, of a file that `numpy.savez` wrote.

    FileError : not an ordinary file, not readable, or beyond a limit. ValueError : damaged.
    """
    with open_bytes(path, WHAT) as stream:
        size.check(os.fstat(stream.fileno()).st_size, WHAT, path)
        length = stream.seek(0, os.SEEK_END)
        if length < END.size:
            raise ValueError("it is too short")
        stream.seek(length - END.size)
        signature, *counts = END.unpack(stream.read(END.size))
        if signature != b"PK\5\6":
            raise ValueError("it is not an archive, or its end is missing")
        ARRAYS_COUNT.check(int(counts[3]), WHAT, path)
        stream.seek(0)
        try:
            with zipfile.ZipFile(stream) as archive:
                members = archive.infolist()
                ARRAYS_COUNT.check(len(members), WHAT, path)
                size.check(sum(member.file_size for member in members), WHAT, path)
                return {
                    member.filename.removesuffix(".npy"): _read_member(archive, member)
                    for member in members
                }
        except FAULTS as error:
            raise ValueError(str(error) or "it ends too early") from error


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Return one array; ValueError where its header does not agree with its bytes."""
    name = member.filename
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f"compression of {name!r}")
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"{name!r} has another version than 1.0")
        shape, is_fortran, kind = np.lib.format.read_array_header_1_0(stream)
        if kind.kind not in KINDS or kind.itemsize == 0:
            raise ValueError(f"{name!r} contains neither numbers nor text")
        if math.prod(shape) * kind.itemsize != member.file_size - stream.tell():
            raise ValueError(f"{name!r} has another size than its header")
        values = np.frombuffer(stream.read(), kind)
    return values.reshape(shape, order="F" if is_fortran else "C")


# What loopcal reads back from the arrays.npz of a run: the declared form of its arrays.

# Arrays by name: what each entry is, and the axes; a letter is one size in all arrays.
FORMS: Mapping[str, str] = {
    "nominal": "finite p",
    "estimate": "finite p",
    "sd": "number p",
    "covariance": "number p p",
    "initial": "finite a",
    "local_estimate": "finite u",
    "local_start": "finite u",
    "local_sd": "number u",
    "local_slope": "finite u p",
    "local_root": "finite u e",
    "local_columns": "whole u e",
    "posterior_unit": "finite p",
    "posterior_directions": "finite p p",
    "posterior_variance": "number p",
    "posterior_seen": "logical p",
    "posterior_source": "text s",
    "posterior_degrees": "number s",
    "posterior_root": "number p c",
    "posterior_part": "whole c",
    "frames_unfixed": "finite 12 motions",
    "frames_readings": "finite poses q",
    "frames_names": "text i",
    "frames_by_motions": "number i 6 12",
    "frames_T": "finite i 4 4",
    "frames_by_parameters": "finite i 6 p",
    "frames_own": "finite i 6 6",
    "discrepancy_root": "finite p m",
    "discrepancy_degrees": "number n",
    "discrepancy_directions": "finite p p",
    "discrepancy_variance": "number p",
    "discrepancy_test": "number 4",
    "discrepancy_mean": "finite j",
    "discrepancy_axes": "finite j j",
    "discrepancy_left": "finite j",
    "discrepancy_tool": "finite 3",
    "discrepancy_rotation": "finite 3 3",
    "discrepancy_origin": "finite 6",
    "discrepancy_length": "number 6",
    "discrepancy_centers": "finite k 6",
    "discrepancy_whitening": "finite k k",
    "discrepancy_amplitude": "finite 6 n",
    "posterior_shown_noise": "number 3",
    "posterior_reading_sigma": "finite q",
    "information_rows": "finite d p",
    "information_deviations": "finite d",
    "information_noise": "number 2",
    "heights_poses": "text h",
    "heights_points": "finite h 2",
    "heights_before": "finite h",
    "heights_after": "finite h",
    "heights_held_out": "logical h",
}
FITTED = "number rows values"  # form of the fitted rows of a kind, `fitted_<number>_<kind>`
# Beginnings of names of which a run has all arrays or none.
GROUPS = ("frames_", "discrepancy_", "heights_", "posterior_shown_", "posterior_reading_")
FITTED_NAME = re.compile(r"fitted_\d+_.+", re.DOTALL)
# Word for an entry -> letter of its type in NumPy.
TYPES = {"finite": "f", "number": "f", "whole": "i", "logical": "b", "text": "U"}


def find_problem(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Return which array is missing or has another form, so that none of another version of
    loopcal is computed with; None where all have theirs.
    """
    present = tuple(group for group in GROUPS if any(name.startswith(group) for name in arrays))
    for name in (name for name in FORMS if name not in arrays):
        if name.startswith(present) or not name.startswith(GROUPS):
            return f"the array {name!r} is missing"
    fitted = {name: FITTED for name in arrays if name.startswith("fitted_")}
    if unknown := [name for name in fitted if not FITTED_NAME.fullmatch(name)]:
        return f"the array {unknown[0]!r} is unknown"
    sizes: dict[str, int] = {}
    for name, form in {**FORMS, **fitted}.items():
        if name in arrays and not _has_form(arrays[name], form, sizes):
            shape = " x ".join(map(str, arrays[name].shape)) or "one"
            stated = f"{shape} of {arrays[name].dtype}"
            return f"the array {name!r} ({stated}) has another form than {form!r}"
    return None


def _has_form(array: np.ndarray, form: str, sizes: dict[str, int]) -> bool:
    """Return whether an array has a form; `sizes` are those of letters, to which it adds its own.

    Of an array without entries, only the first axis counts.
    """
    word, *axes = form.split()
    if array.ndim != len(axes) or array.dtype.kind != TYPES[word]:
        return False
    if word == "text" and array.dtype.itemsize and array.size:
        # characters that UTF-8 can hold; NumPy stores any four bytes
        codes = np.ascontiguousarray(array).view(np.uint32)
        if not np.all((codes < 0xD800) | ((codes > 0xDFFF) & (codes < 0x110000))):
            return False
    if array.dtype.kind == "f" and array.dtype != float:
        return False
    if word == "finite" and not np.isfinite(array).all():
        return False
    for size, axis in zip(array.shape, axes if array.size else axes[:1], strict=False):
        if (match := re.fullmatch(r"(\d*)([a-z]?)", axis)) is None:
            continue  # a word is any size
        factor = int(match[1] or 1)
        if size != factor * (sizes.setdefault(match[2], size // factor) if match[2] else 1):
            return False
    return True


# Run folders: written, and read back.

ROBOT, FAILED_ROBOT = "robot.yaml", "robot-not-calibrated.yaml"
"""The corrected robot file of a run, and that of a calibration that failed."""

FAILED_VERDICT, CONVERGED = "not_calibrated", "converged"
"""Verdict of a calibration that failed, and status of a fit that converged, in result.json."""

WARNING = f"""\
{NOT_CALIBRATED}: the calibration that made this file failed. See result.json in its folder.
"""


def name_robot_file(report: CalibrationReport, force: bool = False) -> str:
    """Return the name of a report's robot file; `force` names a failed one like any other."""
    return FAILED_ROBOT if report.has_failed and not force else ROBOT


def list_reasons(failures: Iterable[object]) -> tuple[str, ...]:
    """Return the sentences of failures without their last full stop, to be joined."""
    return tuple(str(failure).strip().rstrip(".") for failure in failures)


def find_run_failure(path: Path, result: Mapping[str, Any]) -> Finding | None:
    """Return why the numbers of a run are not for a machine; None where they are, or where there is
    no result, as of a robot file.
    """
    if not result:
        return None
    status, reasons = str(result["fit"]["status"]), list_reasons(result["reasons"])
    if status != CONVERGED and not reasons:
        reasons = (f"the fit did not converge ({status.replace('_', ' ')})",)
    # a missed limit is a reason beside the verdict: it says nothing against the geometry
    if status == CONVERGED and result["verdict"] != FAILED_VERDICT:
        return None
    return report_finding("gates.run-not-calibrated", run=str(path), reasons=reasons)


@dataclass(frozen=True, eq=False)
class Run(Result):
    """A calibration read from its run folder, or a robot file as if it were one.

    Parameters
    ----------
    path : of the folder or file. result : content of result.json, empty for a robot file.
    robot : the corrected robot. initial_robot : the robot before the calibration.
    nuisance_values : name -> estimate of frames, targets and surfaces, such as `tracker.x` [SI].
    initial_nuisance_values : the same with the geometry before the calibration.
    arrays : content of arrays.npz, SI.
    """

    path: Path
    result: dict[str, Any]
    robot: Mechanism
    initial_robot: Mechanism
    nuisance_values: Mapping[str, float] = field(default_factory=dict)
    initial_nuisance_values: Mapping[str, float] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        verdict = self.result.get("verdict")
        verdict = f", {verdict.replace('_', ' ')}" if verdict else ""
        return f"<Run {str(self.path)!r}: {self.robot.name}{verdict}>"

    @property
    def failure(self) -> Finding | None:
        """Why the numbers of this run are not for a machine; None where they are."""
        return find_run_failure(self.path, self.result)

    @property
    def identified_robot(self) -> Mechanism:
        """The robot with only those parameters free that the run identified; its file leaves the
        others free, too.
        """
        names = [row["name"] for row in self.result["fit"]["parameters"]]
        return free_only(self.robot, names)

    @property
    def fitted_rows(self) -> FittedRows | None:
        """The rows that the run and those of its prior were fitted to; None for a robot file."""
        return fitted_rows_from_arrays(self.arrays)

    @property
    def held_out(self) -> tuple[str, ...]:
        """Labels of the poses that were held out for validation."""
        return tuple((self.result.get("split") or {"held_out": ()})["held_out"])

    @property
    def excluded(self) -> tuple[str, ...]:
        """Labels of the poses that were excluded from the fit."""
        return tuple(self.result.get("fit", {}).get("dropped") or ())

    def load_posterior(self) -> Posterior:
        """Return estimates and uncertainties, as a prior for new data or for `accuracy_map`.

        Raises
        ------
        EstimationError : it is a robot file, or its robot file was changed.
        """
        return posterior_from_arrays(self.identified_robot, self.arrays)

    def load_stated_errors(self) -> Posterior:
        """Return the posterior of a run whose errors are those to expect of the machine.

        Raises
        ------
        DataError : the run failed, or its residuals contradict the noise. EstimationError : see
            `load_posterior`.
        """
        if self.failure is not None:
            raise DataError(self.failure)
        if self.result.get("states_expected_error") is False:
            raise DataError.of("accuracy.volume-open", reason="noise")
        return self.load_posterior()

    def load_uncertainty(self) -> FitUncertainty | None:
        """Return what the fit knows of machine and setup parameters together, to check other
        measurements; None for a robot file.
        """
        from loopcal.estimate.fit_linearization import uncertainty_from_arrays

        if not self.result:
            return None
        fit, names = self.result["fit"], tuple(self.nuisance_values)
        scale, noise = fit["sigma_scale"], NoiseKnowledge.restore(fit)
        return uncertainty_from_arrays(
            self.identified_robot, names, self.arrays, 1.0 if scale is None else scale, noise
        )

    def load_budget(self) -> dict[str, Any]:
        """Return the uncertainty budget, see `ErrorBudget.to_dict`.

        Raises
        ------
        DataError : the run has no intervals.
        """
        budget = self.result.get("expected_error")
        if budget is None:
            raise DataError.of("files.no-budget", run=str(self.path))
        return dict(budget)

    def load_measurements(self, **allowed: bool) -> tuple[Measurements, Measurements | None]:
        """Return the fitted and the held-out measurements, from the unchanged input files.

        Parameters
        ----------
        allowed : see `loopcal.load_measurements`.

        Returns
        -------
        fitted : without excluded poses. held_out : None where no pose was held out.

        Raises
        ------
        FileError : the run names no data, or a file is missing or was changed since.
        """
        roles = ("data", "poses")
        files = {r: f for r, f in list_inputs(self.result).items() if r.partition("-")[0] in roles}
        if not files:
            sentence = "this run names no measurement files; load them by load_measurements"
            raise FileError(sentence, self.path)
        for file in files.values():
            if sha256(file["path"]) != file["sha256"]:
                sentence = f"this file differs from the file of the run in {self.path}. Restore it"
                raise FileError(sentence, file["path"])
        data = load_measurements([f["path"] for f in files.values()], self.robot, **allowed)
        fitted = [label not in (*self.held_out, *self.excluded) for label in data.labels]
        held_out = [label in self.held_out for label in data.labels]
        return data.take(fitted), data.take(held_out) if any(held_out) else None


EQUAL = 1e-2  # largest difference of a repeated estimate from that of a run, in standard deviations


def repeat_fit(
    run: Run, progress: Progress = report_no_progress
) -> tuple[Identification, Measurements]:
    """Return the fit of a run, made again from its files and its options, and its measurements.

    EstimationError : the estimate is another one. DataError : an option is an object without a
        name. FileError : see `Run.load_measurements`.
    """
    from loopcal.estimate.identification import identify
    from loopcal.estimate.recalibration import recalibrate

    stated = run.result["options"]
    try:
        options = FitOptions.from_dict(stated["fit"])
    except (AttributeError, TypeError, ValueError) as error:
        raise report_damage(run.path / RESULT, f"'options.fit' is {stated['fit']!r}") from error
    options = replace(options, excluded_poses=())  # they are not among the measurements
    data, _ = run.load_measurements(allow_outside_stroke=True, allow_duplicates=True)
    if (prior := list_inputs(run.result).get("prior")) is None:
        fit = identify(run.initial_robot, data, options=options, progress=progress)
    else:
        earlier = load_run(Path(prior["path"]).parent).load_posterior()
        limb = stated.get("free_limb")
        fit, _ = recalibrate(
            run.initial_robot, data, earlier, limb, options=options, progress=progress
        )
    estimate, sd = run.arrays["estimate"], fit.standard_deviations
    allowed = EQUAL * np.where(np.isfinite(sd), sd, np.inf)
    if len(estimate) != len(sd) or (np.abs(fit.estimate - estimate) > allowed).any():
        raise EstimationError.of("sampling.run-not-repeated", run=str(run.path))
    return fit, data


def list_inputs(result: Mapping[str, Any]) -> dict[str, Mapping[str, str]]:
    """Return role -> `path` and `sha256` of the input files of a result."""
    return dict(result["made_by"]["inputs"])


ARRAYS = "arrays.npz"
RUN = outputs.FolderKind("run", RESULT, ("made_by", "fit"), (ARRAYS, ROBOT, FAILED_ROBOT))
# Keys of `made_by` and their meanings, for the file reference.
MADE_BY: Mapping[str, str] = {
    "command": "the command line, as a list of words",
    "versions": "versions of loopcal, numpy, scipy and python, and the engine that computed",
    "seeds": "all seeds in use, by name",
    "inputs": "each input file: its name as given, and its sha256",
}


def collect_provenance(
    command: Sequence[str], inputs: Mapping[str, Path], seeds: Mapping[str, int]
) -> dict[str, Any]:
    """Return the provenance of a result, with the keys of MADE_BY; inputs are role -> file."""
    files = {role: {"path": str(path), "sha256": sha256(path)} for role, path in inputs.items()}
    made_by = {"command": list(command), "versions": collect_versions()}
    return made_by | {"seeds": dict(seeds), "inputs": files}


def write_run_folder(
    path: str | Path,
    result: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    robot_text: str,
    force: bool = False,
    robot_name: str = ROBOT,
) -> Path:
    """Write a run folder whole or not at all, see `write_result_folder`, and return it.

    `files` is added to the result; arrays are in SI; `robot_name` is ROBOT or
    FAILED_ROBOT.
    """
    path = as_path(path, "run folder")
    files: dict[str, bytes | Callable[[Path], object]] = {
        robot_name: robot_text.encode(),
        ARRAYS: lambda file: np.savez(file, allow_pickle=False, **arrays),
    }
    outputs.write_result_folder(path, RUN, result, files, force)
    return path


def read_run_folder(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the contents of result.json and arrays.npz of a run folder.

    FileError : not a run folder, of another format, or damaged; with the file and the damage.
    """
    path = as_path(path, "run folder")
    if not (path / RESULT).is_file():
        is_folder = f"is not a run folder ({RESULT} is missing)"
        sentence = f"this {is_folder if path.exists() else 'run folder does not exist'}"
        leftover = "" if path.exists() else outputs.describe_leftover(path, RESULT)
        advice = leftover or "name a folder that a calibration wrote"
        raise FileError(f"{sentence}; {advice}", path)
    names = (ARRAYS, _find_robot_file(path).name)
    if missing := [name for name in names if not (path / name).is_file()]:
        sentence = f"this run folder lacks {' and '.join(missing)}"
        raise FileError(f"{sentence}. Restore it, or repeat the calibration", path)
    result = read_result(path / RESULT)
    if sha256(path / ARRAYS) != result["files"].get(ARRAYS):
        raise report_damage(path / ARRAYS, "it is not the file that result.json names")
    try:
        arrays = read_arrays(path / ARRAYS)
    except ValueError as error:
        raise report_damage(path / ARRAYS, f"reading it fails ({error})") from error
    if problem := find_problem(arrays):
        raise report_damage(path / ARRAYS, problem)
    for name, key in (("estimate", "parameters"), ("local_estimate", "local")):
        rows, holds = result["fit"][key], f"but the array {name!r} of the run holds"
        estimates = arrays[name].tolist()
        if len(estimates) != len(rows):
            stated = f"'fit.{key}' has {len(rows)} entries, {holds} {len(estimates)}"
            raise report_damage(path / RESULT, stated)
        for row, value in zip(rows, estimates, strict=True):
            factor = UNITS[row["unit"]].factor_to_si if row["unit"] in UNITS else math.nan
            if not math.isclose(row["estimate"] * factor, value, rel_tol=ROUNDING):
                stated = f"'fit.{key}' states {row['estimate']!r} {row['unit']} for {row['name']}"
                raise report_damage(path / RESULT, f"{stated}, {holds} {value!r} [SI]")
    return result, arrays


def _find_robot_file(path: Path) -> Path:
    """Return the robot file of a run folder, which has another name where the run failed."""
    failed = path / FAILED_ROBOT
    return failed if failed.is_file() else path / ROBOT


def save_run(
    report: CalibrationReport,
    path: str | Path,
    inputs: Mapping[str, Path] | None = None,
    command: Sequence[str] = (),
    force: bool = False,
) -> Path:
    """Write the run folder of a calibration, and return it.

    Parameters
    ----------
    report : of `loopcal.calibrate`, with a robot from `load_robot`. path : the folder to make.
    inputs : role -> file, such as `{"robot": .., "data": ..}`; their names and digests are kept.
    command : the command line that made the report.
    force : replace an older run, and call the robot file of a calibration that failed robot.yaml.

    Raises
    ------
    FileError : the folder is in use, or cannot be written; an input cannot be read.
    MechanismError : the robot was not loaded from a file.
    """
    path = as_path(path, "run folder")
    document = build_document(report, inputs, command)
    text = remove_mark(format_robot(report.robot, report.identification.plus_minus))
    name = name_robot_file(report, force)
    text = WARNING + text if report.has_failed else text
    return write_run_folder(path, document, report.arrays(), text, force, name)


def build_document(
    report: CalibrationReport, inputs: Mapping[str, Path] | None = None, command: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the content of result.json; see `save_run`."""
    files = {role: as_path(file, "input") for role, file in (inputs or {}).items()}
    provenance = collect_provenance(command, files, report.provenance.seeds)
    return {"format": FORMAT, "made_by": provenance, **json_fields(report)}


def load_run(path: str | Path) -> Run:
    """Read the run folder of a calibration.

    Raises
    ------
    FileError : not a run folder, damaged, or of another format.
    """
    path = as_path(path, "run folder")
    result, arrays = read_run_folder(path)
    robot = load_robot(_find_robot_file(path))
    before = arrays["initial"]
    # others may be free, too, because a choice of the model identifies some of them
    stated, table = [row["name"] for row in result["fit"]["parameters"]], robot.parameters
    free = [name for name, is_free in zip(table.names, table.free, strict=True) if is_free]
    if [name for name in free if name in stated] != stated or len(before) != len(table):
        name = (sorted({*stated} - {*free}) or free)[0]
        raise FileError.of(
            "files.run-robot-changed", _find_robot_file(path), result=RESULT, name=name
        )
    initial = robot.with_values(before)
    names = [row["name"] for row in result["fit"]["local"]]
    values, initial_values = (
        dict(zip(names, arrays[key].tolist(), strict=True))
        for key in ("local_estimate", "local_start")
    )
    return Run(path, result, robot, initial, values, initial_values, arrays)


def refuse_changed_run(run: Run) -> None:
    """Raise FileError where a file of a run folder is not the one that the calibration wrote."""
    changed = outputs.list_changed_files(run.path, RUN)
    if changed:
        raise FileError.of("files.run-changed", run.path, files=changed)


def load_run_or_robot(path: str | Path) -> Run:
    """Read a run folder, or a robot file (or a shipped robot by its name) as if it were a run.

    FileError : neither of them.
    """
    path = as_path(path, "run folder or robot file")
    if path.is_dir() or (not path.exists() and str(path) not in list_shipped_robots()):
        return load_run(path)
    robot = load_robot(path)
    return Run(path, {}, robot, robot.nominal)


def find_failure(path: str | Path) -> Finding | None:
    """Return why the numbers of a run, or of a robot file, are not for a machine.

    The robot file of a calibration that failed states it, wherever the file is.
    """
    path = as_path(path, "run folder or robot file")
    folder = path.parent if path.name in (ROBOT, FAILED_ROBOT) else path
    result = read_run_folder(folder)[0] if (folder / RESULT).is_file() else {}
    if failure := find_run_failure(folder, result):
        return failure
    if not path.is_file() or not read_yaml(path, "robot file").text.startswith(NOT_CALIBRATED):
        return None
    return report_finding("gates.run-not-calibrated", run=str(path), reasons=())
