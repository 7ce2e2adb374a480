# SPDX-License-Identifier: Apache-2.0
"""OpenCV's own boards, and pictures of them by a camera of our own."""

import cv2

from loopcal.io.board import Board


def make_charuco(board: Board) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's board [m]."""
    number = getattr(cv2.aruco, f"DICT_{board.dictionary}")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    return cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, dictionary)
