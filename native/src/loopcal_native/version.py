# SPDX-License-Identifier: Apache-2.0
"""The version of this package."""

VERSION = "0.1.0.dev0"
"""Read from here by the build, too; importlib.metadata takes a third as long to import as numpy."""
