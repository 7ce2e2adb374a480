# SPDX-License-Identifier: Apache-2.0
"""What a worker computes: machines, measurements, fits and scores of a block of trials."""
