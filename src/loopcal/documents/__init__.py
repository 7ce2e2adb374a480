# SPDX-License-Identifier: Apache-2.0
"""Documents as files: reports of calibrations (HTML, JSON, PDF), and comparisons of them."""

from loopcal.documents.comparison import write_comparison as write_comparison
from loopcal.documents.writing import write_report as write_report
