# SPDX-License-Identifier: Apache-2.0
"""What the residuals of a fit show of their errors, and how its uncertainty allows for it."""
