# SPDX-License-Identifier: Apache-2.0
"""Frames of the measurements, as arrays of a run folder."""

import numpy as np
import pytest

from loopcal.estimate.posterior import FrameKnowledge, InstrumentFrame, frames_from_arrays


@pytest.mark.parametrize("count", [0, 1, 3])
def test_arrays_of_a_run_folder_return_the_frames(count):
    """An inclinometer has no frame; its run could not be written."""
    rng = np.random.default_rng(count)
    instruments = {
        f"tracker{i}": InstrumentFrame(np.eye(4), rng.standard_normal((6, 5)), np.eye(6))
        for i in range(count)
    }
    frames = FrameKnowledge(rng.standard_normal((12, 2)), rng.standard_normal((7, 3)), instruments)
    restored = frames_from_arrays(frames.arrays())
    assert restored is not None
    assert np.array_equal(restored.unfixed, frames.unfixed)
    assert list(restored.instruments) == list(instruments)
    for name, frame in instruments.items():
        assert np.array_equal(restored.instruments[name].by_parameters, frame.by_parameters)
