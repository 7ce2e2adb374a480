# SPDX-License-Identifier: Apache-2.0
"""Firmware of delta printers: Klipper, Marlin, RepRapFirmware."""
