# SPDX-License-Identifier: Apache-2.0
"""Actuation: which joints are driven, by fewer readings than joints, or by more than freedoms."""
