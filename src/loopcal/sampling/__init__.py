# SPDX-License-Identifier: Apache-2.0
"""Uncertainty beyond the linear interval: block bootstrap, sampled posterior, joint regions."""

from loopcal.sampling.block_bootstrap import Bootstrap as Bootstrap
from loopcal.sampling.block_bootstrap import bootstrap as bootstrap
from loopcal.sampling.intervals import Intervals as Intervals
from loopcal.sampling.joint_regions import JointRegion as JointRegion
from loopcal.sampling.joint_regions import SimultaneousIntervals as SimultaneousIntervals
from loopcal.sampling.joint_regions import compute_joint_region as compute_joint_region
from loopcal.sampling.joint_regions import (
    compute_simultaneous_intervals as compute_simultaneous_intervals,
)
from loopcal.sampling.posterior_sample import PosteriorSample as PosteriorSample
from loopcal.sampling.posterior_sample import sample_posterior as sample_posterior
