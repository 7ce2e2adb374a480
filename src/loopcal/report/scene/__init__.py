# SPDX-License-Identifier: Apache-2.0
"""A robot with its measured poses in space, for pictures and for the interactive 3-D view."""
