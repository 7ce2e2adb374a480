# SPDX-License-Identifier: Apache-2.0
"""Files: robots, measurements, run folders, and files of other programs."""
