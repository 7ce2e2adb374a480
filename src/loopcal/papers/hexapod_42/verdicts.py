# SPDX-License-Identifier: Apache-2.0
"""What agrees with the paper and what does not, and why: each sentence is made from the numbers of
this run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from loopcal.mechanism import forward
from loopcal.papers.hexapod_42.leg_form import LegForm
from loopcal.papers.hexapod_42.published import MM, ODD_POSE, to_values
from loopcal.papers.hexapod_42.steps import actual_poses, form, twists
from loopcal.papers.hexapod_42.study_noise import PRESUMED, STATED, Level, published_sizes
from loopcal.papers.hexapod_42.study_table_4 import rotation_formula
from loopcal.papers.reproduction import ASKED_HERE, Verdict
from loopcal.typing import FloatArray

if TYPE_CHECKING:
    from loopcal.papers.hexapod_42.compare import Results

TO_PRINTED = np.array([1.0 / MM] * 3 + [1.0] * 3)


def verdicts(found: Results) -> tuple[Verdict, ...]:
    """Judge every statement."""
    return (*_machine(found), *_table_4(found), *_iteration(found), *_after(found), *_method(found))


def _machine(found: Results) -> tuple[Verdict, ...]:
    second, third = found.comparisons["table_2"], found.comparisons["table_3"]
    return (
        Verdict(
            "Table 2 is a hexapod of threefold symmetry.",
            second.agreeing == second.count,
            f"{second.count - second.agreeing} of {second.count} numbers differ from the symmetric "
            "ones by more than a unit of"
            f" their last digit, none by more than {second.largest:.1g} mm. Everything below uses "
            "Table 2 as printed.",
            ASKED_HERE,
        ),
        Verdict(
            "From exact poses the ten steps find the assumed errors (Table 3): the parameters "
            "converge one by one.",
            third.agreeing == third.count,
            f"After {found.printed.iterations + 1} iterations without noise the largest parameter "
            "error is"
            f" {third.largest:.1g} mm.",
            "section 5.4",
        ),
    )


def _table_4(found: Results) -> tuple[Verdict, ...]:
    printed, best, second = rotation_formula(found.printed.order), found.orders[0], found.orders[1]
    stated = next(o for o in found.orders if o.formula == printed)
    fourth, odd = found.comparisons["table_4"], found.comparisons["table_4_a2"]
    result = np.array([not label.endswith("PT") for label in fourth.published.labels])
    good, bad = (result & (odd_one == np.array([label.startswith(f"{ODD_POSE} ") for label in fourth.published.labels]))
                 for odd_one in (False, True))  # fmt: skip
    named = next(o for o in found.outliers.first if o.label == ODD_POSE)
    return (
        Verdict(
            f"The tables follow from the rotation matrix of equation (2), {printed}.",
            best.formula == printed,
            f"Of all {len(found.orders)} products of three turns, R = {best.formula} fits Table 4, "
            f"to {best.position:.1e}"
            f" mm and {best.rotation:.1e} rad rms, which is rounding; equation (2) leaves "
            f"{stated.position:.1e} mm and"
            f" {stated.rotation:.1e} rad, the next best {second.position:.1e} mm and "
            f"{second.rotation:.1e} rad.",
            "section 2",
        ),
        Verdict(
            f"The actual poses of Table 4 follow from Tables 2 and 3 in all rows but {ODD_POSE}.",
            bool(fourth.within[good].all()),
            f"{int(fourth.within[good].sum())} of {fourth.within[good].size} numbers (PP, E1) "
            "agree to one unit of their"
            " last digit.",
            "section 5.2",
        ),
        Verdict(
            f"Row {ODD_POSE} of Table 4 is a pose of the same machine.",
            bool(fourth.within[bad].all()),
            f"{int((~fourth.within[bad]).sum())} of its {fourth.within[bad].size} numbers (PP, E1) "
            "differ. It is a pose"
            f" of the machine with all six errors of leg lengths zero: so computed, {odd.agreeing} "
            f"of {odd.count} numbers"
            " agree to one unit. The outlier test, which knows nothing of Table 3, names"
            f" {' and '.join(found.outliers.named) or 'no pose'}: without {ODD_POSE} chi-square "
            f"falls by {named.drop:.3g}"
            f" to {named.chi_square:.3g} with {named.degrees:.0f} degrees of freedom.",
            "Table 4",
        ),
        Verdict(
            "Measured poses in Table 4 contain a random error within +-0.001 mm.",
            best.position > found.printed.noise / MM / np.sqrt(3.0) / 3.0,
            f"They differ from poses computed without noise by {best.position:.1e} mm rms, which "
            "is their rounding; such"
            f" noise would be {found.printed.noise / MM / np.sqrt(3.0):.1e} mm rms.",
            "section 5.2",
        ),
        _rounding(found),
    )


def _rounding(found: Results) -> Verdict:
    rows = next(t for t in found.tables if t.name == "rounding").rows
    before, as_printed, repaired, without, full, weighted, prior = (
        float(str(row[2])) for row in rows
    )
    return Verdict(
        "From Table 4 as printed the paper's method can identify the 42 parameters.",
        max(as_printed, repaired, without) < before,
        f"Parameter errors are {as_printed:.2g} mm rms as printed; {without:.2g} mm without row "
        f"{ODD_POSE} and"
        f" {repaired:.2g} mm with that row put right, by rounding alone, against {before:.2g} mm "
        "before calibration and"
        f" {full:.0e} mm from the same poses in full: the poses lie close together (tilt up to 3 "
        "degrees), so little"
        f" noise makes large parameter errors. Without row {ODD_POSE}, with all legs weighted by "
        "the rounding:"
        f" {weighted:.2g} mm, and with tolerances as prior (MAP) {prior:.2g} mm.",
        ASKED_HERE,
    )


def _iteration(found: Results) -> tuple[Verdict, ...]:
    k, threshold = found.printed.iterations, found.printed.threshold
    stated = _level(found, STATED)
    met = int(np.isfinite(stated.needed).sum())
    exact, frozen = found.exact.integrated, found.frozen.integrated
    return (
        Verdict(
            f"max dQint falls below {threshold:g} after {k} iterations (figure 4).",
            found.exact.needed(threshold) == k and found.frozen.needed(threshold) == k,
            f"Without noise, yes: {exact[0]:.6f}, {exact[1]:.2g}, {exact[2]:.2g} after 0, 1, 2 "
            "iterations with the matrix"
            f" made anew, {frozen[2]:.2g} after 2 with one matrix throughout. dQint adds "
            "millimetres and radians.",
            "section 5.4, figure 4",
        ),
        Verdict(
            f"It does so with the stated noise of +-{found.printed.noise / MM:g} mm.",
            met == len(stated.needed),
            f"In {met} of {len(stated.needed)} drawings: max dQint stays at {stated.median[3]:.1e} "
            "(median), the size of"
            " the noise, which no calibration removes from the measured poses. (Angles: "
            f"+-{STATED[1]:g} rad; the paper"
            " states none.)",
            "sections 5.2 and 5.4",
        ),
    )


def _after(found: Results) -> tuple[Verdict, ...]:
    sizes, presumed, stated = (
        published_sizes(found.printed),
        _level(found, PRESUMED),
        _level(found, STATED),
    )
    holding = [level for level in found.levels if level.holds(sizes)]
    names = (
        ", ".join(f"+-{level.limits[0]:g} mm with +-{level.limits[1]:g} rad" for level in holding)
        or "no level tried"
    )
    explained = _explained(found)
    return (
        Verdict(
            f"Tables 5 and 6 were made with the stated noise of +-{found.printed.noise / MM:g} mm.",
            stated in holding,
            f"Parameter errors, residuals and max dQint ({sizes[2]:.1e} mm, {sizes[0]:.1e} mm, "
            f"{sizes[1]:.1e} rad,"
            f" {sizes[3]:.1e}) lie together in what was drawn with {names}, with no other level "
            "tried; the stated noise gives"
            f" {stated.median[2]:.1e} mm, {stated.median[0]:.1e} mm, {stated.median[1]:.1e} rad, "
            f"{stated.median[3]:.1e}."
            " 0.001 mm is 1e-6 m: perhaps metres were taken for millimetres.",
            "section 5.2",
        ),
        Verdict(
            "The errors after calibration in Table 6 are residuals of this least-squares problem.",
            bool(explained.max() < 0.25),
            f"Parameters could explain {100 * explained.min():.0f} to {100 * explained.max():.0f} "
            "% of each leg's norm of"
            " them; of ten random numbers and seven parameters it would be "
            f"{100 * np.sqrt(0.7):.0f} %, of exact"
            " residuals 0.",
            ASKED_HERE,
        ),
        Verdict(
            "Angles in Table 6 are in mrad, as its heading says.",
            not found.comparisons["table_6_before"].within[_good_rows(found), 3:].all(),
            "Read as rad, the angles before calibration agree with computed ones to their last "
            "digit in all rows but"
            f" {ODD_POSE} (and with Table 4, which says rad).",
            "Table 6",
        ),
        _offset(found, presumed),
    )


def _offset(found: Results, presumed: Level) -> Verdict:
    """Tables 5 and 6 together give back the noise: residual = noise + D (true - corrected
    parameters).
    """
    noise = recovered_noise(found)
    mean, scatter = noise.mean(axis=0) * TO_PRINTED, noise.std(axis=0, ddof=1) * TO_PRINTED
    limit = np.array([presumed.limits[0]] * 3 + [presumed.limits[1]] * 3)
    lengths, angles = (", ".join(f"{value:.1e}" for value in part) for part in (mean[:3], mean[3:]))
    return Verdict(
        "The noise behind Tables 5 and 6 has mean zero.",
        bool(np.all(np.abs(mean) < 4.0 * scatter / np.sqrt(len(noise)))),
        "Noise = residual (Table 6) minus what the parameter errors (Table 5) do to the poses: all "
        "ten poses share an"
        f" offset of ({lengths}) mm, ({angles}) rad, about which they scatter by only "
        f"{scatter[:3].max():.1e} mm and"
        f" {scatter[3:].max():.1e} rad (sd; +-{limit[0]:g} mm would be "
        f"{limit[0] / np.sqrt(3.0):.1e} mm). We have no"
        " explanation for the offset. Residuals do not show it, because parameters can follow a "
        "shift of all poses.",
        "section 5.2, random error",
    )


def _method(found: Results) -> tuple[Verdict, ...]:
    before, alone, together, prior = found.methods
    ten, seven = (_poses_row(found, n) for n in (10, 7))
    return (
        Verdict(
            "Calibration with the stated noise reduces the parameter errors.",
            alone.parameters < before.parameters,
            f"Leg by leg they are {alone.parameters:.2g} mm rms afterwards, "
            f"{before.parameters:.2g} mm before:"
            f" {alone.parameters / before.parameters:.1f} times as large. With tolerances as "
            "priors (MAP):"
            f" {prior.parameters:.2g} mm. In the first drawing {_smaller(found, STATED)} of 42 "
            "errors decrease; with"
            f" {PRESUMED[0]:g} mm and {PRESUMED[1]:g} rad, {_smaller(found, PRESUMED)}.",
            "section 5.4, Table 5",
        ),
        Verdict(
            "Calibration with the stated noise improves the positioning.",
            alone.narrow < before.narrow and alone.wide < before.wide,
            f"On unseen poses in the range of the paper from {before.narrow:.2g} to "
            f"{alone.narrow:.2g} mm rms, in the"
            f" wide range from {before.wide:.2g} to only {alone.wide:.2g} mm: wrong parameters "
            "make up for each other"
            f" near the measured poses. MAP: {prior.narrow:.2g} and {prior.wide:.2g} mm.",
            "section 5.4, Table 6",
        ),
        Verdict(
            "Six separate least-squares problems, one for each leg, are as good as one.",
            alone.parameters < 1.1 * together.parameters,
            "With the stated noise the parameter errors are "
            f"{alone.parameters / together.parameters:.1f} times those of"
            f" one problem over all legs weighted by the noise ({alone.parameters:.2g} against "
            f"{together.parameters:.2g}"
            " mm rms): the noise of a pose is common to its six legs, and leg by leg this is not "
            "used.",
            ASKED_HERE,
        ),
        Verdict(
            "Seven poses are enough (n >= 7).",
            bool(np.isfinite(float(str(seven[3])))) and seven[2] is not None,
            "For the count, yes: 42 equations for 42 parameters, and exact poses give the "
            f"parameters in {seven[2]}"
            " iterations. But no residual is left to check them by, and the condition of a leg is"
            f" {float(str(seven[3])):.0f} against {float(str(ten[3])):.0f} with ten.",
            "section 3",
        ),
    )


def recovered_noise(found: Results) -> FloatArray:
    """(n, 6) [m, rad] noise that Tables 5 and 6 together imply."""
    study, printed = found.study, found.printed
    actual = actual_poses(study)
    D = LegForm.at(study.truth, forward(study.truth, study.commanded.q, study.commanded)).D
    by_coordinates = np.concatenate(
        [D[:, 3:], form(study.order).rates_inverse(actual[:, 3:]) @ D[:, :3]], axis=1
    )
    errors = to_values(study.robot, printed.parameter_errors_after.values * 1e-3 * MM)
    return printed.pose_errors_after.values / TO_PRINTED - by_coordinates @ errors


def _explained(found: Results) -> FloatArray:
    """(6,) share of each leg's residuals of Table 6 that parameters could explain."""
    study = found.study
    legs = LegForm.at(study.truth, forward(study.truth, study.commanded.q, study.commanded))
    return legs.explained(
        twists(
            found.printed.pose_errors_after.values / TO_PRINTED, actual_poses(study), study.order
        )
    )


def _smaller(found: Results, limits: tuple[float, float]) -> int:
    """How many parameter errors are smaller after calibration, in the first drawing of this noise."""
    run = found.presumed if limits == PRESUMED else found.stated
    errors = np.abs(run.parameter_errors(found.study.truth))
    return int((errors[found.printed.iterations] < errors[0]).sum())


def _level(found: Results, limits: tuple[float, float]) -> Level:
    return next(level for level in found.levels if level.limits == limits)


def _good_rows(found: Results) -> np.ndarray:
    return np.array([label != ODD_POSE for label in found.printed.pose_errors_before.labels])


def _poses_row(found: Results, number: int) -> tuple:
    return next(
        row for row in next(t for t in found.tables if t.name == "poses").rows if row[1] == number
    )
