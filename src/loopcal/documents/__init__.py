# SPDX-License-Identifier: Apache-2.0
"""Documents as files: the report of a calibration as HTML, JSON and PDF."""

from loopcal.documents.writing import write_report as write_report
