# SPDX-License-Identifier: Apache-2.0
"""What the stored trials say: summaries, answers to questions, figures, exports, status."""
