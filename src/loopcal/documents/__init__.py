# SPDX-License-Identifier: Apache-2.0
"""Documents as files: reports of calibrations (HTML, JSON, PDF), comparisons of them, 3-D views."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.documents.comparison import write_comparison as write_comparison
    from loopcal.documents.view_writing import write_view as write_view
    from loopcal.documents.writing import write_report as write_report
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.documents.comparison": "write_comparison",
            "loopcal.documents.view_writing": "write_view",
            "loopcal.documents.writing": "write_report",
        },
    )
