# SPDX-License-Identifier: Apache-2.0
"""The command line: parse arguments, call one library function, print a view of its result."""
