# SPDX-License-Identifier: Apache-2.0
"""Plan which poses to measure."""
