#!/usr/bin/env python3
"""Follows corners through a folder of images and writes a box for each sighting, as JSON lines.

It plays a detector for pictures that hold no fire: corners that stand still in the world, picked and
followed in the left images alone (no poses, no right images, no range), so that what is ranged and
placed from its boxes can be judged by whether it stays where it is. A box stands on its corner: the
corner is the middle of the lower edge, because that is the pixel that an alarm's position is about.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from mavclient import print_json

FLOW = {
    "winSize": (15, 15),
    "maxLevel": 4,
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 0.001),
}
FORTH_AND_BACK_PX = 0.3  # a corner that does not come back to itself was lost


class Track:
    def __init__(self, frame, corner):
        self.first = frame
        self.corners = [corner]

    @property
    def last(self):
        return self.corners[-1]


class Follower:
    def __init__(self, args):
        self.args = args
        self.alive, self.ended = [], []
        self.before = None

    def see(self, frame, image):
        if self.before is not None and self.alive:
            self.follow(image)
        self.seek(frame, image)
        self.before = image

    def follow(self, image):
        then = np.float32([track.last for track in self.alive]).reshape(-1, 1, 2)
        now, found, _ = cv2.calcOpticalFlowPyrLK(self.before, image, then, None, **FLOW)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(image, self.before, now, None, **FLOW)
        error = np.linalg.norm(back - then, axis=2).ravel()
        good = (found.ravel() == 1) & (returned.ravel() == 1) & (error < FORTH_AND_BACK_PX)
        kept = []
        for track, corner, is_good in zip(self.alive, now.reshape(-1, 2), good, strict=True):
            if is_good and self.is_inside(corner, image):
                track.corners.append(corner)
                kept.append(track)
            else:
                self.ended.append(track)
        self.alive = kept

    def is_inside(self, corner, image):
        height, width = image.shape
        border = self.args.border_px
        return border <= corner[0] < width - border and border <= corner[1] < height - border

    def seek(self, frame, image):
        """New corners, away from those that are followed already and from the border."""
        free = np.zeros_like(image)
        border = self.args.border_px
        free[border:-border, border:-border] = 255
        for track in self.alive:
            cv2.circle(free, tuple(int(v) for v in track.last), self.args.apart_px, 0, -1)
        wanted = self.args.corners - len(self.alive)
        if wanted > 0:
            found = cv2.goodFeaturesToTrack(image, wanted, 0.02, self.args.apart_px, mask=free, blockSize=7)
            for corner in [] if found is None else found.reshape(-1, 2):
                self.alive.append(Track(frame, corner))

    def tracks(self):
        """Those that were followed long enough, in the order in which they began."""
        enough = [t for t in self.ended + self.alive if len(t.corners) >= self.args.frames]
        return sorted(enough, key=lambda t: (t.first, *map(float, t.corners[0])))


def boxes(tracks, side):
    """Best first within a frame means: in the order of the tracks."""
    for number, track in enumerate(tracks):
        for index, (u, v) in enumerate(track.corners):
            yield {
                "sequence": track.first + index,
                "x": round(float(u), 3) - side / 2,
                "y": round(float(v), 3) - side,
                "width": side,
                "height": side,
                "class": "fire",
                "score": 0.9,
                "label": f"corner-{number}",
            }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("images", type=Path, help="folder of left images, in the order of their names")
    add("out", type=Path)
    add("--corners", type=int, default=120, help="followed at once")
    add("--apart-px", type=int, default=36)
    add("--border-px", type=int, default=40, help="no corner nearer to the image's border")
    add("--frames", type=int, default=8, help="fewest frames of a track")
    add("--side-px", type=int, default=24, help="side of a box")
    args = parser.parse_args()
    follower = Follower(args)
    names = sorted(args.images.glob("*.png"))
    for frame, name in enumerate(names):
        follower.see(frame, cv2.imread(str(name), cv2.IMREAD_GRAYSCALE))
    tracks = follower.tracks()
    lines = sorted(boxes(tracks, args.side_px), key=lambda box: box["sequence"])
    args.out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    print_json({"images": len(names), "tracks": len(tracks), "boxes": len(lines)})


if __name__ == "__main__":
    main()
