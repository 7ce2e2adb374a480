# SPDX-License-Identifier: Apache-2.0
"""Diagnose what data can determine, and whether they agree with themselves and with a fit."""
