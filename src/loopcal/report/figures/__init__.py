# SPDX-License-Identifier: Apache-2.0
"""Results as figures of matplotlib, in one style: functions that return a Figure."""
