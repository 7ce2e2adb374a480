# SPDX-License-Identifier: Apache-2.0
"""loopcal beside Ceres, scipy and jax: the same fits in one run, `python -m benchmarks.peers`."""
