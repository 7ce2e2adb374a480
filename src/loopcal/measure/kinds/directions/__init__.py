# SPDX-License-Identifier: Apache-2.0
"""Kinds that measure directions: an axis of the platform, or gravity on the platform."""
