# SPDX-License-Identifier: Apache-2.0
"""How fast loopcal is, and whether it stays so."""
