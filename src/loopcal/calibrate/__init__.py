# SPDX-License-Identifier: Apache-2.0
"""From rows to parameters: identify, what can be identified, filters, validation."""

from loopcal.calibrate.descent import DescentStatus as DescentStatus
from loopcal.calibrate.descent import StepControl as StepControl
from loopcal.calibrate.filters import MAP as MAP
from loopcal.calibrate.filters import LeastSquares as LeastSquares
from loopcal.calibrate.filters import Ridge as Ridge
from loopcal.calibrate.filters import TruncatedSVD as TruncatedSVD
