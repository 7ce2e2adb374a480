# SPDX-License-Identifier: Apache-2.0
"""LinuxCNC: the joints of a hexapod in HAL, and the offsets of its struts in the INI file."""
