# SPDX-License-Identifier: Apache-2.0
"""Text exports of measuring instruments, read as a profile says and written as measurement files."""

from loopcal.io.exports.conversion import Converted as Converted
from loopcal.io.exports.conversion import convert_export as convert_export
from loopcal.io.exports.profile import Profile as Profile
from loopcal.io.exports.profile import read_profile as read_profile
