# SPDX-License-Identifier: Apache-2.0
"""Whether a machine differs between two calibrations of independent data, and where."""

from loopcal.diagnose.machine_changes.change_causes import ChangeCause as ChangeCause
from loopcal.diagnose.machine_changes.change_causes import estimate_cause as estimate_cause
from loopcal.diagnose.machine_changes.change_causes import explain_change as explain_change
from loopcal.diagnose.machine_changes.parameter_changes import ParameterChanges as ParameterChanges
from loopcal.diagnose.machine_changes.parameter_changes import (
    compare_information as compare_information,
)
