# SPDX-License-Identifier: Apache-2.0
"""Results in notebooks: HTML, and tables of pandas and xarray.

`pages.py` says which text and tables show a result, `records.py` collects its numbers with names
and units, from which its table on the page, its DataFrame and its Dataset are made.
"""

from loopcal.report.notebook.html import render_html as render_html
from loopcal.report.notebook.pages import render_result as render_result
from loopcal.report.notebook.tables import build_dataset as build_dataset
from loopcal.report.notebook.tables import build_frame as build_frame
