# SPDX-License-Identifier: Apache-2.0
"""Fix the coordinates of frames, tools and targets that no motion of a machine determines.

A camera that measures x and y of a planar machine has a frame of six numbers, of which three act:
its tilt and its distance change no measured value to first order. Left free, they act to second
order, as a scale of x and y, and take errors of the machine away. The columns of an item by its own
numbers are collected at its stated place, over measured poses and over poses of the workspace. A
combination without effect on both is removed by fixing a coordinate, of a rotation first, at its
stated value. See docs/theory/observability.md.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np

from loopcal.errors import LoopcalError, MechanismError
from loopcal.estimate.free_parameters import choose_pivots
from loopcal.estimate.pose_estimate import fit_nuisance_values, predict_from_readings
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.geometry import exp_so3, log_so3
from loopcal.measure.initial_values import evaluate_measurements, find_equal_values, whiten_rows
from loopcal.measure.kinds.setup_parameters import POSITION_AXES, ROTATION_AXES
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import StatedValue
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.statistics import choose_evenly, find_distinct
from loopcal.typing import FloatArray

AXES = (*ROTATION_AXES, *POSITION_AXES)

NO_EFFECT = 1e-8
"""Share of the largest effect of the coordinates of an item, rotations divided by the robot's size,
up to which a combination of them has none: the square root of double rounding.
"""

POSES = 30
"""Number of measured poses, evenly chosen, and of poses of the workspace, at which effects are
compared: five for each number of a frame.
"""

MISPLACED = 10.0
"""Factor by which free coordinates must reduce the residuals (rms) at nominal geometry for the
stated place to be far off, so that nothing is fixed. Errors of a machine that a tilt takes away are
small compared with its motion, which an instrument on another side sees in another direction.
"""


APART, SURE = 0.05, 6.0
"""Rotation [rad], or displacement in robot sizes, and number of standard deviations from which two
solutions are two places, and not one that is known poorly.
"""


def fix_undetermined_setup(robot: Mechanism, data: Measurements) -> Measurements:
    """Return measurements in which coordinates of the setup that no motion of a robot determines
    are fixed at their stated values; see `StatedValue.is_undetermined`.

    Items that rows of several poses, of other bodies or with joint values depend on stay as they
    are, and so do those without a workspace in which they could be tested.
    """
    table = data.nuisance_parameters.table
    if not (table.free & np.isnan(table.tolerance)).any():
        return data
    nominal = robot.with_values(robot.parameters.nominal)
    try:
        solution, known = predict_from_readings(
            nominal, data.take(choose_evenly(data.n_poses, POSES))
        )
    except LoopcalError:  # a fit says why
        return data
    names = _find_undetermined(nominal, data, solution.T[solution.converged & known])
    if not names:
        return data
    stated = (StatedValue(name, is_undetermined=True) for name in names)
    fixed = replace(data, stated_values=(*data.stated_values, *stated))
    return data if _is_misplaced(nominal, data, fixed) else fixed


def report_fixed_setup(data: Measurements) -> list[Finding]:
    """Return which coordinates `fix_undetermined_setup` fixed."""
    present = set(data.nuisance_parameters.table.names)
    fixed = [v.name for v in data.stated_values if v.is_undetermined and v.name in present]
    return [report_finding("setup.fixed", names=tuple(fixed))] if fixed else []


def report_equal_setup(fit: Identification, data: Measurements) -> list[Finding]:
    """Return which frames, tools and targets of a fit are elsewhere in another solution that fits
    the measurements alike, such as a camera that is tilted to the other side.
    """
    setup, poses = fit.nuisance, choose_evenly(data.n_poses, POSES)
    if not len(setup):
        return []
    part = data.take(poses)
    solution, known = predict_from_readings(fit.robot, part)
    used = solution.converged & known
    part, T = part.take(used), solution.T[used]
    local = part.nuisance_parameters
    if any(rows.kind.sensed_joints for rows in part.all_observations) or not len(T):
        return []
    place_of = {name: i for i, name in enumerate(setup.names)}
    places = np.array([place_of[name] for name in local.table.names], dtype=np.int64)
    values, sd = setup.estimate[places], setup.sd[places]
    others = find_equal_values(part, T, local, values)
    owners: dict[str, list[int]] = defaultdict(list)
    for i, name in enumerate(local.table.names):
        if name.rpartition(".")[2] in AXES:
            owners[name.rpartition(".")[0]].append(i)
    findings = []
    for owner, of_owner in owners.items():
        turning = [i for i in of_owner if local.table.names[i].rpartition(".")[2] in ROTATION_AXES]
        compared = turning or of_owner
        if not np.isfinite(sd[compared]).all():
            continue
        if len(turning) == len(ROTATION_AXES):
            turn = exp_so3(others[:, turning]) @ exp_so3(values[turning]).T
            distance, least = np.linalg.norm(log_so3(turn), axis=-1), APART
        else:
            distance = np.linalg.norm((others - values)[:, compared], axis=1)
            least = APART if turning else APART * fit.robot.size
        elsewhere = np.flatnonzero(distance > np.maximum(least, SURE * sd[compared].max()))
        if len(elsewhere):
            other = others[elsewhere[np.argmin(distance[elsewhere])]]
            rows = tuple(
                {
                    "name": local.table.names[i],
                    "value": fit.robot.to_quantity(values[i], local.table.entries[i].dimension),
                    "other": fit.robot.to_quantity(other[i], local.table.entries[i].dimension),
                }
                for i in compared
            )
            findings.append(report_finding("setup.two-solutions", name=owner, places=rows))
    return findings


def _find_undetermined(robot: Mechanism, data: Measurements, T: FloatArray) -> list[str]:
    """Return the full names of the setup parameters to fix, from measured poses (n, 4, 4)."""
    columns, others = defaultdict(list), set[str]()
    for i, rows in enumerate(data.all_observations):
        for owner, places in _list_places(rows).items():
            if rows.kind.poses_per_row > 1 or rows.kind.of or rows.kind.sensed_joints:
                others.add(owner)
            else:
                columns[owner].append((i, rows, places))
    parts = [_linearize_setup(rows, T) for rows in data.all_observations]
    has_workspace = False
    names: list[str] = []
    table = data.nuisance_parameters.table
    for owner in (owner for owner in columns if owner not in others):
        used = columns[owner]
        axes = _choose_fixed(robot, used, parts)
        if axes and not has_workspace:
            try:
                workspace = sample_workspace(robot, POSES).solution.T
            except MechanismError:  # no stated workspace
                return []
            more = (_linearize_setup(rows, workspace) for rows in data.all_observations)
            parts = [np.concatenate(of_kind) for of_kind in zip(parts, more, strict=True)]
            has_workspace = True
            axes = _choose_fixed(robot, used, parts)
        for i, _, places in used:
            for axis in (axis for axis in AXES if axis in axes and axis in places):
                entered = find_distinct(data.nuisance_parameters.indices[i][:, places[axis]])
                entries = (table.entries[k] for k in entered)
                names += [p.name for p in entries if p.free and p.tolerance is None]
    return list(dict.fromkeys(names))


def _list_places(rows: Observations) -> dict[str, dict[str, int]]:
    """Return where the coordinates of each unknown frame, tool and target are: owner -> axis ->
    place among the parameters of the kind.
    """
    owners: dict[str, dict[str, int]] = defaultdict(dict)
    for place, parameter in enumerate(rows.kind.nuisance_parameters):
        owner, _, axis = parameter.name.rpartition(".")
        if axis in AXES and not rows.kind.is_drift[place]:
            owners[owner][axis] = place
    return owners


def _linearize_setup(rows: Observations, T: FloatArray) -> FloatArray:
    """Return derivatives (n m, u) of one row at poses (n, 4, 4), whitened as the most complete one,
    by its setup parameters; none where it has none or compares poses.
    """
    kind = rows.kind
    if kind.poses_per_row > 1 or kind.of or kind.sensed_joints or not kind.nuisance_parameters:
        return np.zeros((0, len(kind.nuisance_parameters)))
    best = int(np.argmax(rows.present.sum(axis=1)))
    noise = np.zeros((1, len(T), len(kind.noise_columns)))
    by_setup = kind.evaluate(T[None], kind.measure(T[None], noise), kind.nominal_values[None, None])
    u = len(kind.nuisance_parameters)
    assert by_setup.nuisance is not None
    return (rows.whitener[best] @ by_setup.nuisance[0]).reshape(-1, u)


def _choose_fixed(
    robot: Mechanism, used: list[tuple[int, Observations, dict[str, int]]], parts: list[FloatArray]
) -> set[str]:
    """Return the axes of an item to fix so that no combination is without effect, from derivatives
    of every kind (`_linearize_setup`); none where rotations that act are not about axes of the
    base.
    """
    present = [axis for axis in AXES if any(axis in places for _, _, places in used)]
    unit = np.array([1.0 / robot.size if axis in ROTATION_AXES else 1.0 for axis in present])
    blocks = []
    for i, _, places in used:
        block = np.zeros((len(parts[i]), len(present)))
        for axis, place in places.items():
            block[:, present.index(axis)] = parts[i][:, place]
        blocks.append(block * unit)
    rows = np.concatenate([*blocks, np.zeros((len(present), len(present)))])
    _, s, vt = np.linalg.svd(np.linalg.qr(rows, mode="r"))
    null = vt[s <= NO_EFFECT * s[0]].T
    if not null.shape[1] or s[0] == 0.0:  # an item that was never measured is no matter of motion
        return set()
    is_rotation = np.array([axis in ROTATION_AXES for axis in present])
    pivots = choose_pivots((null * np.where(is_rotation, 1.0, NO_EFFECT**0.5)[:, None]).T, True)
    left = np.setdiff1d(np.flatnonzero(is_rotation), pivots)
    if (np.abs(null[left]) > NO_EFFECT**0.5).any():
        return set()
    return {present[i] for i in pivots}


def _is_misplaced(robot: Mechanism, data: Measurements, fixed: Measurements) -> bool:
    """Return whether an item is far from its stated place; see `MISPLACED`."""
    names = {value.name for value in fixed.stated_values if value.is_undetermined}
    entries, indices = data.nuisance_parameters.table.entries, data.nuisance_parameters.indices
    concerned = tuple(
        rows
        for rows, places in zip(data.all_observations, indices, strict=True)
        if names & {entries[i].name for i in find_distinct(places)}
    )
    poses = choose_evenly(data.n_poses, POSES)
    size = []
    for of in (data, fixed):
        part = replace(of, observations=concerned, base_observations=()).take(poses)
        solution, known = predict_from_readings(robot, part)
        part = part.take(solution.converged & known)
        T = solution.T[solution.converged & known]
        try:
            values = fit_nuisance_values(robot, part, T)
        except LoopcalError:  # too few rows for a start
            return False
        evaluated = evaluate_measurements(part, T[None], values[None])
        rows = whiten_rows(evaluated, np.zeros((1, len(T), 6, 0)))
        size.append(float(np.linalg.norm(rows[..., -1])))
    return size[1] > MISPLACED * size[0]
