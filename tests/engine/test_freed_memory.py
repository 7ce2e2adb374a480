# SPDX-License-Identifier: Apache-2.0
"""Temporary arrays of the NumPy engine find the memory of earlier ones."""

import platform
import subprocess
import sys

import pytest

COUNT_FAULTS = """
import resource
import numpy as np
import loopcal as lc

robot = lc.load_robot("hexapod-42")
q = np.random.default_rng(0).uniform(-0.01, 0.01, (10_000, 6))
lc.forward(robot, q)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    lc.forward(robot, q)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc alone adapts its limits")
def test_further_calls_cause_few_page_faults(monkeypatch):
    monkeypatch.setenv("LOOPCAL_ENGINE", "numpy")
    monkeypatch.delenv("LD_PRELOAD", raising=False)  # sanitizers replace the C library's memory
    # Dask states it for its workers, in the environment of the process that begins a cluster
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    words = [sys.executable, "-c", COUNT_FAULTS]
    faults = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    assert int(faults) < 5000  # 20,000 where each call takes its memory from the system
