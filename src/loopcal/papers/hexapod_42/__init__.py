# SPDX-License-Identifier: Apache-2.0
"""The 42-parameter hexapod: ten poses, errors assumed, poses simulated, parameters identified leg
by leg.

published.yaml holds what is printed; steps.py does what the paper does; noise_study.py
and table_4_study.py vary it; study.py presents it; verdicts.py judges.
"""
