# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration as one document: sections of sentences, tables and pictures."""
