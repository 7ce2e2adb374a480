# SPDX-License-Identifier: Apache-2.0
"""Reading and writing text, CSV, JSON and YAML."""
