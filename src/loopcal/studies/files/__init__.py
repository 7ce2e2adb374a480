# SPDX-License-Identifier: Apache-2.0
"""What a study has on disk: the study file, the folder with its store, and shares of it."""
