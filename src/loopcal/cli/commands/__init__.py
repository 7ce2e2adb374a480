# SPDX-License-Identifier: Apache-2.0
"""The commands of loopcal: each parses, calls the library and prints."""
