# SPDX-License-Identifier: Apache-2.0
"""The descent of a fit: filtered, robust, and from linearized closure."""
