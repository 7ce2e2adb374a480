# SPDX-License-Identifier: Apache-2.0
"""Poses of the machine: linearized, estimated where readings are uncertain, and predicted."""
