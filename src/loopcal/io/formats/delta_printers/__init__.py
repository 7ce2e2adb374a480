# SPDX-License-Identifier: Apache-2.0
"""Delta printers: geometry and probed heights, as Klipper, Marlin and RepRapFirmware write them."""
