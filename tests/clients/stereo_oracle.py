"""OpenCV's own stereo calibration of corners that `emberfix calibrate stereo --corners FILE` wrote.

    stereo_oracle.py FILE

prints the parameters in emberfix's order: fx fy cx cy k1 k2 p1 p2 k3 of the left and of the right camera,
the rotation vector, the translation in metres; and OpenCV's RMS.
"""

import json
import sys

import cv2
import numpy as np


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        found = json.load(file)
    size = tuple(found["image_size_px"])
    board, left, right = [], [], []
    for view in found["views"]:
        here = {corner["id"]: corner for corner in view["right"]}
        both = [(corner, here[corner["id"]]) for corner in view["left"] if corner["id"] in here]
        board.append(np.array([[*corner["board_m"], 0.0] for corner, _ in both], np.float32))
        left.append(np.array([corner["pixel"] for corner, _ in both], np.float32))
        right.append(np.array([corner["pixel"] for _, corner in both], np.float32))
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)
    _, k1, d1, _, _ = cv2.calibrateCamera(board, left, size, None, None, criteria=stop)
    _, k2, d2, _, _ = cv2.calibrateCamera(board, right, size, None, None, criteria=stop)
    rms, k1, d1, k2, d2, turn, move, _, _ = cv2.stereoCalibrate(
        board, left, right, k1, d1, k2, d2, size, flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=stop
    )

    def camera(k, d):
        return [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()[:5]]

    values = [*camera(k1, d1), *camera(k2, d2), *cv2.Rodrigues(turn)[0].ravel(), *move.ravel()]
    print(json.dumps({"values": [float(value) for value in values], "rms_px": float(rms)}))


if __name__ == "__main__":
    main()
