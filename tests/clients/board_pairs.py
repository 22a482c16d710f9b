"""Pictures of a board, printed and seen by OpenCV, through two pinhole cameras whose numbers are printed.

    board_pairs.py FOLDER chess|charuco [PAIRS]

writes FOLDER/left_001.png, right_001.png .. and prints the truth as JSON. A ChArUco board hangs out of the
pictures here and there; a chessboard never does.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

SIZE = (640, 480)
LEFT = np.array([[520.0, 0, 322.0], [0, 520.0, 238.0], [0, 0, 1]])
RIGHT = np.array([[517.0, 0, 316.0], [0, 517.0, 243.0], [0, 0, 1]])
TURN = cv2.Rodrigues(np.radians([0.4, -0.7, 0.3]))[0]
MOVE = np.array([-0.075, 0.0006, -0.0011])
SQUARE_M, MARKER_M = 0.028, 0.021
SQUARES = (9, 6)  # of the ChArUco board; the chessboard has as many inner corners
DOT = 40  # pixels of the print a square
FINE = 3  # rendered this much finer, then averaged


def printed(kind):
    """The print with a white margin of a square, and its upper left corner in metres."""
    columns, rows = SQUARES
    if kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, MARKER_M, dictionary)
        picture = board.generateImage((columns * DOT, rows * DOT))
    else:
        columns, rows = columns + 1, rows + 1
        y, x = np.mgrid[0 : rows * DOT, 0 : columns * DOT]
        # Dark between the first four inner corners.
        picture = np.where((x // DOT + y // DOT) % 2 == 0, 20, 235).astype(np.uint8)
    picture = cv2.copyMakeBorder(picture, DOT, DOT, DOT, DOT, cv2.BORDER_CONSTANT, value=235)
    return picture, (columns, rows)


def poses(count, squares, whole):
    """Everywhere in the picture, facing and tilted each way, near and far."""
    tilts = [(0, 0), (32, 0), (-32, 0), (0, 32), (0, -32)]
    places = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    # Eyes that stand apart share little of what is near: only a far board comes to both pictures' sides.
    depths = (0.34, 0.85, 0.5) if whole else (0.34, 0.55, 0.42)
    for k in range(count):
        x, y = places[(4 * k) % 9]
        about_x, about_y = tilts[k % 5]
        depth = depths[(k // 2) % 3]
        turn = cv2.Rodrigues(np.radians([about_x + k % 7, about_y, 3.0 * (k % 4) - 4]))[0]
        yield turn, placed(turn, squares, (x, y), depth) if whole else hung_out(x, y, depth)


def hung_out(x, y, depth):
    """The middle of a board that hangs out of the pictures here and there."""
    return np.array([0.375 * x * depth - 0.5 * MOVE[0], 0.25 * y * depth, depth])


def placed(turn, squares, towards, depth):
    """The middle of a board that is as far towards a corner or side of the pictures as both see it whole."""
    while True:
        for share in np.arange(1.0, -0.01, -0.05):
            x, y = share * np.array(towards) * np.array(SIZE) / 2 / LEFT[0, 0] * depth
            middle = np.array([x - 0.5 * MOVE[0], y, depth])
            if is_whole(turn, squares, middle):
                return middle
        depth *= 1.02


def is_whole(turn, squares, middle, margin_px=3):
    half = (np.array(squares) / 2 + 0.15) * SQUARE_M
    outline = np.array([[a * half[0], b * half[1], 0] for a in (-1, 1) for b in (-1, 1)])
    for camera, rotate, move in ((LEFT, np.eye(3), np.zeros(3)), (RIGHT, TURN, MOVE)):
        seen_at = (rotate @ (turn @ outline.T + middle[:, None]) + move[:, None]).T @ camera.T
        pixels = seen_at[:, :2] / seen_at[:, 2:]
        if (pixels < margin_px).any() or (pixels > np.array(SIZE) - margin_px).any():
            return False
    return True


def seen(picture, squares, camera, turn, middle):
    """The print at a pose (its own middle at `middle`), averaged from a finer picture, with noise."""
    metres = SQUARE_M / DOT
    centre = (np.array(squares) / 2 + 1) * SQUARE_M
    to_board = np.array(
        [[metres, 0, 0.5 * metres - centre[0]], [0, metres, 0.5 * metres - centre[1]], [0, 0, 1.0]]
    )
    plane = np.column_stack([turn[:, 0], turn[:, 1], middle])
    finer = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    whole = (SIZE[0] * FINE, SIZE[1] * FINE)
    fine = cv2.warpPerspective(
        picture, finer @ camera @ plane @ to_board, whole, flags=cv2.INTER_LINEAR, borderValue=120
    )
    mean = cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)
    mean = cv2.GaussianBlur(mean, (0, 0), 0.5)
    noise = np.random.default_rng(int(middle.sum() * 1e9) % 2**32).normal(0, 2, mean.shape)
    return np.clip(mean + noise, 0, 255).astype(np.uint8)


def main():
    folder, kind = Path(sys.argv[1]), sys.argv[2]
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 30
    picture, squares = printed(kind)
    folder.mkdir(parents=True, exist_ok=True)
    for k, (turn, middle) in enumerate(poses(count, squares, kind == "chess")):
        left = seen(picture, squares, LEFT, turn, middle)
        right = seen(picture, squares, RIGHT, TURN @ turn, TURN @ middle + MOVE)
        cv2.imwrite(str(folder / f"left_{k + 1:03}.png"), left)
        cv2.imwrite(str(folder / f"right_{k + 1:03}.png"), right)
    truth = {
        "left": [LEFT[0, 0], LEFT[1, 1], LEFT[0, 2], LEFT[1, 2]],
        "right": [RIGHT[0, 0], RIGHT[1, 1], RIGHT[0, 2], RIGHT[1, 2]],
        "rotation": cv2.Rodrigues(TURN)[0].ravel().tolist(),
        "translation_m": MOVE.tolist(),
        "square_mm": 1e3 * SQUARE_M,
        "marker_mm": 1e3 * MARKER_M,
    }
    print(json.dumps(truth))


if __name__ == "__main__":
    main()
