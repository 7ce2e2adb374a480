# SPDX-License-Identifier: Apache-2.0
"""Least squares, ridge and truncated SVD compared (doi:10.1177/1687814016667908), repeated."""
