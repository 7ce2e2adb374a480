# SPDX-License-Identifier: Apache-2.0
"""Check conventions: units, orders, signs, columns and setup parameters of measurements."""

from loopcal.diagnose.conventions.convention_check import IMPLAUSIBLE as IMPLAUSIBLE
from loopcal.diagnose.conventions.convention_check import ConventionCheck as ConventionCheck
from loopcal.diagnose.conventions.convention_check import check_conventions as check_conventions
from loopcal.diagnose.conventions.convention_check import compare_conventions as compare_conventions
from loopcal.diagnose.conventions.interpretations import Interpretation as Interpretation
from loopcal.diagnose.conventions.reading_interpretations import (
    list_reading_interpretations as list_reading_interpretations,
)
from loopcal.diagnose.conventions.setup_parameters import MovedSetups as MovedSetups
from loopcal.diagnose.conventions.setup_parameters import find_moved_setups as find_moved_setups
from loopcal.diagnose.conventions.stroke_explanation import (
    explain_outside_strokes as explain_outside_strokes,
)
from loopcal.diagnose.conventions.value_interpretations import (
    list_interpretations as list_interpretations,
)
