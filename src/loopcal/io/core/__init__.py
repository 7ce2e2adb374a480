# SPDX-License-Identifier: Apache-2.0
"""Text, CSV, JSON and YAML files, and records read from them."""
