# SPDX-License-Identifier: Apache-2.0
"""The command line: parse arguments, call one library function, print a view of its result."""

from loopcal.cli.entry_point import command_line as command_line
from loopcal.cli.entry_point import main as main
