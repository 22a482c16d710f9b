"""Prints the bits of OpenCV's ArUco markers, row by row, 1 is white: {"4x4_250": ["1011..", ..], ..}."""

import json

import cv2


def main():
    sets = {}
    for side in (4, 5, 6, 7):
        name = getattr(cv2.aruco, f"DICT_{side}X{side}_250")
        dictionary = cv2.aruco.getPredefinedDictionary(name)
        # Drawn with one pixel a bit and a black border of one.
        drawn = [dictionary.generateImageMarker(marker, side + 2) for marker in range(250)]
        inside = [picture[1:-1, 1:-1].ravel() for picture in drawn]
        sets[f"{side}x{side}_250"] = ["".join("1" if bit else "0" for bit in bits) for bits in inside]
    print(json.dumps(sets))


if __name__ == "__main__":
    main()
