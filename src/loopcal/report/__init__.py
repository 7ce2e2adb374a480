# SPDX-License-Identifier: Apache-2.0
"""Results as people look at them: text pages, tables, figures."""
