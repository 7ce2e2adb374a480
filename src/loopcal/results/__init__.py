# SPDX-License-Identifier: Apache-2.0
"""How results describe themselves, and what follows from it (example: tests/results)."""
