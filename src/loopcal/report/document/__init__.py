# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration as one document: sections of sentences, tables and pictures.

A section is computed from a `CalibrationRecord`; `page` renders sections as HTML and as JSON.
"""
