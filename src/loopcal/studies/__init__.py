# SPDX-License-Identifier: Apache-2.0
"""Studies: many simulated calibrations, described by a file, resumable and reproducible."""
