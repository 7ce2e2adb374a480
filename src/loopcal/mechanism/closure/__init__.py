# SPDX-License-Identifier: Apache-2.0
"""The closure of limbs: frames along a limb, its linearized rows, and loops that stay open."""
