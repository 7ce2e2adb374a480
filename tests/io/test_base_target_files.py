# SPDX-License-Identifier: Apache-2.0
"""Measurement files with targets that are fixed to the base: their form and mistakes in them."""

import numpy as np
import pytest

import loopcal as lc
from loopcal.errors import DataError, FileError

ROBOT = lc.load_robot("linear-delta")
PLACES = np.array([[0.3, -0.25, 0.0], [0.2, 0.35, 0.05], [-0.35, 0.05, 0.02]])
POSES = """\
# kind: position
# targets: [tip]
# places: [[0 mm, 0 mm, 0 mm]]
# unknown: [frame]
# noise: {"*": 15 um}
pose,session,q1 [mm],q2 [mm],q3 [mm],x [mm],y [mm],z [mm]
1,am,10,10,10,0,0,0
2,am,10,12,10,3,1,0
3,pm,12,10,10,4,-1,0
"""
BASE = """\
# kind: position
# of: base
# targets: [N1, N2, N3]
# places: [[300 mm, -250 mm, 0 mm], [200 mm, 350 mm, 50 mm], [-350 mm, 50 mm, 20 mm]]
# unknown: [frame]
# noise: {"*": 15 um}
session,N1.x [mm],N1.y [mm],N1.z [mm],N2.x [mm],N2.y [mm],N2.z [mm],N3.x [mm],N3.y [mm],N3.z [mm]
am,300.01,-250,0,200,350,50,-350,50,20
am,300.02,-250,0,200,350,50,-350,50,20
pm,300.03,-250,0,200,350,50,,,
"""


def read(paths):
    return lc.load_measurements(paths, ROBOT)


def test_a_file_of_the_base_has_neither_poses_nor_readings(write_files):
    for files in (write_files(points=POSES, base=BASE), write_files(base=BASE, points=POSES)):
        data = read(files)
        assert data.labels == ("1", "2", "3")
        (rows,) = data.base_observations
        assert rows.session.tolist() == ["am", "am", "pm"]
        assert rows.n_residuals == 24
        assert rows.measured[1, 0] == pytest.approx(0.30002)
        assert data.n_rows == 9


def test_both_kinds_share_a_file(write_files, tmp_path):
    data = read(write_files(points=POSES, base=BASE))
    path = tmp_path / "both.csv"
    lc.save_measurements(data, path, ROBOT)
    again = lc.load_measurements(path, ROBOT)
    assert "of: base" in path.read_text()
    assert again.labels == data.labels
    before, after = data.base_observations[0], again.base_observations[0]
    np.testing.assert_allclose(after.measured, before.measured, rtol=1e-12)
    assert after.session.tolist() == before.session.tolist()
    assert tuple(after.kind.target_columns) == ("N1", "N2", "N3")


def test_unknown_places_may_have_a_prior(write_files):
    text = BASE.replace("[frame]", '[frame, targets]\n# unknowns: {"N?.*": {sd: 20 um}}')
    table = read(write_files(points=POSES, base=text)).nuisance_parameters.table
    stated = dict(zip(table.names, table.tolerance, strict=True))
    # one place holds in both sessions, the frame does not
    assert stated["N1.x"] == pytest.approx(20e-6)
    assert {name for name in table.names if name.endswith("frame.x")} == {
        "am.frame.x",
        "pm.frame.x",
    }


MISTAKES = {
    "an unknown target": (("N3.z", "N4.z"), "base.csv:7: column 'N4.z' is unknown"),
    "a pose in a row": (
        ("session,N1.x", "pose,session,N1.x", "am,300.01", "1,am,300.01"),
        "base.csv:8: this row measures the base and belongs to no pose, but column 'pose' is '1'",
    ),
    "a reading in a row": (
        ("session,N1.x", "q1 [mm],session,N1.x", "am,300.01", "10,am,300.01"),
        "base.csv:8: this row measures the base and belongs to no pose, but column 'q1' is '10'",
    ),
    "a held-out row": (
        ("session,N1.x", "use,session,N1.x", "am,300.01", "held-out,am,300.01"),
        "base.csv:8: this row measures the base and belongs to no pose, but column 'use'",
    ),
    "a misspelled body": (
        ("of: base", "of: bse"),
        "base.csv:2: 'linear-delta' has no stage or body 'bse'",
    ),
    "no places": (
        (
            ", [200 mm, 350 mm, 50 mm], [-350 mm, 50 mm, 20 mm]]\n",
            "]\n",
            "# places: [[300 mm, -250 mm, 0 mm]]\n",
            "",
        ),
        "base.csv:3: the places of N1, N2, N3 on the base are neither given nor unknown",
    ),
    "a separate frame": (
        ("unknown: [frame]", "unknown: [frame]\n# frame: tracker"),
        "base.csv:6: Only rows of targets on the base measure the frame 'tracker'",
    ),
    "a frame that is not unknown": (
        ("# unknown: [frame]\n", ""),
        "base.csv:2: The frame of the instrument is known for N1, N2 and N3",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_its_line(write_files, mistake):
    changes, expected = MISTAKES[mistake]
    text = BASE
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        assert old in text
        text = text.replace(old, new)
    if mistake in ("a pose in a row", "a reading in a row", "a held-out row"):
        text = text.replace("\nam,300.02", "\n,am,300.02").replace("\npm", "\n,pm")
    with pytest.raises((FileError, DataError)) as caught:
        read(write_files(points=POSES, base=text))
    assert expected in str(caught.value)


ONE = """\
# kind: position
# of: base
# targets: [N1]
# places: [[300 mm, -250 mm, 0 mm]]
# unknown: [frame]
# noise: {"*": 15 um}
session,x [mm],y [mm],z [mm]
am,300,-250,0
"""
PLANE = POSES.replace("# targets: [tip]\n# places: [[0 mm, 0 mm, 0 mm]]\n", "# of: base\n")
WRONG_SETS = {
    "a target on two bodies": (
        {"points": POSES.replace("[tip]", "[N2]"), "base": BASE},
        r"base.csv:3: .*N2",
        "data.target-on-two-bodies",
    ),
    "one target": ({"points": POSES, "base": ONE}, "base.csv:3", "data.single-base-target"),
    "the base alone": ({"base": BASE}, "Give the file of the poses", None),
    "a kind that measures no points": (
        {"points": PLANE.replace("kind: position", "kind: plane")},
        "position, bearing or distance",
        None,
    ),
}


@pytest.mark.parametrize("case", WRONG_SETS)
def test_files_that_do_not_belong_together_are_refused(write_files, case):
    texts, message, code = WRONG_SETS[case]
    with pytest.raises(FileError, match=message) as caught:
        read(write_files(**texts))
    assert caught.value.code == code
