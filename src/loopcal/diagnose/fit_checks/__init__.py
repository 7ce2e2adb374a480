# SPDX-License-Identifier: Apache-2.0
"""Check a fit with the data it was made from: outliers, repeated poses, start values, readings."""
