# SPDX-License-Identifier: Apache-2.0
"""Text exports of measuring instruments, converted to measurement files by means of a profile."""
