# SPDX-License-Identifier: Apache-2.0
"""Documents as files: reports of calibrations (HTML, JSON, PDF), comparisons of them, 3-D views."""

from loopcal.documents.comparison import write_comparison as write_comparison
from loopcal.documents.view_writing import write_view as write_view
from loopcal.documents.writing import write_report as write_report
