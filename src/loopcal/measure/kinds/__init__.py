# SPDX-License-Identifier: Apache-2.0
"""Kinds of measurements, one file each; `KINDS` is the registry that files, templates, documentation and tests read."""

from loopcal.measure.kinds.component import Component as Component
from loopcal.measure.kinds.kind import Column as Column
from loopcal.measure.kinds.kind import Evaluation as Evaluation
from loopcal.measure.kinds.kind import Kind as Kind
from loopcal.measure.kinds.pose import Pose as Pose

KINDS: dict[str, type[Kind]] = {kind.name: kind for kind in (Pose, Component)}
