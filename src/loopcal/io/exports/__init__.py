# SPDX-License-Identifier: Apache-2.0
"""Text exports of measuring instruments, converted to measurement files by means of a profile."""

from loopcal.io.exports.conversion import Conversion as Conversion
from loopcal.io.exports.conversion import convert_export as convert_export
from loopcal.io.exports.conversion import save_conversion as save_conversion
from loopcal.io.exports.profile import Profile as Profile
from loopcal.io.exports.profile_reader import read_profile as read_profile
from loopcal.io.exports.shipped_profiles import find_profile_file as find_profile_file
from loopcal.io.exports.shipped_profiles import list_shipped_profiles as list_shipped_profiles
from loopcal.io.exports.shipped_profiles import with_local_settings as with_local_settings
