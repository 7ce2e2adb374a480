# SPDX-License-Identifier: Apache-2.0
"""A hexapod calibrated from planes and perpendicular lines (doi:10.5772/45684), repeated."""
