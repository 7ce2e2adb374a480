# SPDX-License-Identifier: Apache-2.0
"""
Which probe, and how many points? A small study
===============================================

Before you buy a probe, simulate it: a study draws many machines from the expected spreads,
measures and calibrates each of them, and compares the result with the truth. This one takes a
second. It asks how many points a delta robot needs with a cheap and with a good camera.
"""

# %%
# A study is a file. Each combination of its levels is a cell, here four numbers of points times
# two cameras, with 100 machines in each.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/study.png"
import tempfile
from pathlib import Path

import loopcal as lc

STUDY = """
format: 1
title: Cameras and points for a delta robot
seed: 3
replicates: 100
robots: [linear-delta]
instruments:
  camera: {kinds: [component], components: [x, y, z], sigma_position: 20 um}
noise: [1, 3]       # a camera of 20 um, and one of 60 um
poses: [8, 15, 30, 60]
questions:
  number of points: {factor: poses, score: position_max, limit: 100 um, share: 0.95}
"""
folder = Path(tempfile.mkdtemp())
(folder / "study.yaml").write_text(STUDY)

if __name__ == "__main__":  # needed only where worker processes compute
    result = lc.study(folder / "study.yaml", folder / "results")

# %%
# The error of the calibrated machines at poses that were not measured: median and range of the
# 100 machines. The truth of every machine is known, so these are true errors.

result.draw("position")

# %%
# The question of the file: how many points keep the largest error of 95 % of the machines below
# 100 um?

for answer in result.answer_questions():
    print(answer)

# %%
# Are the stated uncertainties true? Intervals of 95 % must contain the truth in 95 % of all
# cases. All trials are one table, for any other question.

table = result.to_frame()
print(table.groupby(["noise", "poses"])[["covered_parameters", "covered_position"]].mean())
