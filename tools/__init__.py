# SPDX-License-Identifier: Apache-2.0
"""What the developers of loopcal run; no part of the package."""
