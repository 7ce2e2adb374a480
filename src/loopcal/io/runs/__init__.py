# SPDX-License-Identifier: Apache-2.0
"""Run folders and plan folders."""
