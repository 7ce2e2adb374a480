# SPDX-License-Identifier: Apache-2.0
"""What a mechanism can do: its workspace and limits, its singularities, its modes."""
