# SPDX-License-Identifier: Apache-2.0
"""Published studies, repeated by this library: printed numbers beside computed ones."""
