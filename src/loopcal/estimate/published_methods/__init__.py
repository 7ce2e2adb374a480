# SPDX-License-Identifier: Apache-2.0
"""Methods of published studies, for comparison: raw rows with full steps, and leg by leg."""
