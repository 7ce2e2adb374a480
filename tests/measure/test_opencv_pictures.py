# SPDX-License-Identifier: Apache-2.0
"""Pictures of a chessboard that nobody here made, against `cv2.calibrateCamera`.

They belong to Debian's package opencv-doc, which is read in place, or unpacked in a folder of the
test; nothing of it is copied into this repository.
"""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from loopcal.measure.kinds.image import LENS, calibrate_camera

FOLDER = Path("usr/share/doc/opencv-doc/examples/data")
BOARD = np.array([[i % 9, i // 9, 0.0] for i in range(54)])
OF_OPENCV = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return the folder of the pictures."""
    pytest.importorskip("cv2")
    if (installed := Path("/") / FOLDER).exists():
        return installed
    place = tmp_path_factory.mktemp("opencv-doc")
    place.chmod(0o777)  # apt downloads as a user of its own
    try:
        for command in (["apt-get", "-q", "download", "opencv-doc"], ["sh", "-c", UNPACK]):
            subprocess.run(command, cwd=place, check=True, capture_output=True, timeout=120)
    except (OSError, subprocess.SubprocessError) as error:
        pytest.skip(f"Debian's package opencv-doc cannot be installed here: {error}")
    return place / FOLDER


UNPACK = "dpkg-deb -x opencv-doc*.deb ."


def find_corners(folder: Path, side: str):
    """Return the corners (n, 54, 2) of one camera, and the size of a picture."""
    cv2 = pytest.importorskip("cv2")
    found = []
    size = (0, 0)
    for file in sorted(folder.glob(f"{side}*.jpg")):
        picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        size = picture.shape[::-1]
        is_found, corners = cv2.findChessboardCorners(picture, (9, 6))
        if is_found:
            end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
            corners = cv2.cornerSubPix(picture, corners, (11, 11), (-1, -1), end)
            found.append(corners.reshape(-1, 2))
    return np.array(found, dtype=float), size


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [(), ("k3",), ("k3", "p1", "p2")], ids=",".join)
@pytest.mark.parametrize("side", ["left", "right"])
def test_lens_and_residuals_of_a_chessboard_agree_with_opencv(folder, side, fixed) -> None:
    cv2 = pytest.importorskip("cv2")
    pixels, size = find_corners(folder, side)
    assert len(pixels) == 13
    flags = cv2.CALIB_FIX_K3 if "k3" in fixed else 0
    flags |= cv2.CALIB_ZERO_TANGENT_DIST if "p1" in fixed else 0
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 300, 1e-14)
    rms, K, distortion, turns, shifts, of_lens, *_ = cv2.calibrateCameraExtended(
        [BOARD.astype(np.float32)] * len(pixels),
        [corners.astype(np.float32)[:, None] for corners in pixels],
        size,
        None,
        None,
        flags=flags,
        criteria=end,
    )
    expected = dict(
        zip(OF_OPENCV, [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()[:5]], strict=True)
    )
    expected["aspect"] = expected["fy"] / expected["fx"] - 1.0
    sd = dict(zip(OF_OPENCV, of_lens.ravel()[:9], strict=True))
    start = np.array([np.nan, np.nan, 0.5 * (size[0] - 1), 0.5 * (size[1] - 1), *[0.0] * 5])
    free = ~np.isin(LENS, fixed)
    fit = calibrate_camera(BOARD, pixels, start, free)
    for name, value, own in zip(LENS, fit.lens, fit.sd, strict=True):
        assert value == pytest.approx(expected[name], abs=1e-3 * own + 1e-12)
        assert name == "aspect" or own == pytest.approx(sd[name], rel=1e-3)
    assert fit.rms == pytest.approx(rms, rel=1e-6)
    projected = [
        cv2.projectPoints(BOARD, turn, shift, K, distortion)[0][:, 0]
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    # [px] a thousandth of the noise; both minimize the same sum, to a few 1e-8
    np.testing.assert_allclose(fit.residuals, np.array(projected) - pixels, atol=4e-4)
