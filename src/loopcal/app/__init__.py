# SPDX-License-Identifier: Apache-2.0
"""The page of `loopcal app`: a server on this computer for people who do not use a terminal."""
