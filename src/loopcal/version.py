# SPDX-License-Identifier: Apache-2.0
"""The version of loopcal, which results and files state."""

__version__ = "0.1.0.dev0"
