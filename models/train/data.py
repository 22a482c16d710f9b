"""Pictures in memory, the mix of samples and the augmentation.

Boxes are rows (class, x1, y1, x2, y2) in px of the picture they belong to. A `valid` map at
1/8 of the canvas says where a class may be judged: bit 0 fire, bit 1 smoke. Where masks are known, `ids`
[h, w] has k + 1 at the pixels of box k (fire before smoke where both are), 0 elsewhere.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.random import Generator
from torch.utils.data import IterableDataset

from . import masks, synth

THERMAL_SETS = ("fcdnet_thermal",)
RGB_SETS = ("continuous_fire6", "abonia_cctv", "dfire_none99")
GREY = 114


@dataclass(slots=True)
class Picture:
    """One decoded picture: BGR uint8 [h, w, 3], its boxes, whether smoke is labelled, its clip, and which
    pixels are which box, where anything is known of that."""

    image: np.ndarray
    boxes: np.ndarray
    smoke: bool
    clip: str
    name: str
    ids: np.ndarray | None = None


def read_labels(path: Path, w: int, h: int) -> tuple[np.ndarray, np.ndarray | None]:
    """YOLO text, shares of the picture -> boxes [n, 5] in px, and `ids` where labels are outlines. A line is
    class cx cy w h, or class x y x y ..."""
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [np.array(line.split(), np.float32) for line in lines if line.strip()]
    boxes, marks = [], []
    for row in rows:
        if len(row) == 5:
            c, half = row[1:3], row[3:5] / 2
            boxes.append(np.r_[row[0], (c - half) * (w, h), (c + half) * (w, h)])
        else:
            corners = row[1:].reshape(-1, 2) * (w, h)
            boxes.append(np.r_[row[0], corners.min(0), corners.max(0)])
            marks.append(masks.fill(corners, h, w))
    boxes = np.array(boxes, np.float32).reshape(-1, 5)
    return boxes, identify(boxes, marks, h, w) if len(marks) == len(rows) > 0 else None


def identify(boxes: np.ndarray, marks: list[np.ndarray] | np.ndarray, h: int, w: int) -> np.ndarray:
    """A mask per box -> `ids`; fire goes before smoke, small before large."""
    ids = np.zeros((h, w), np.uint8)
    area = np.prod(boxes[:, 3:] - boxes[:, 1:3], -1)
    for k in np.lexsort((-area, -boxes[:, 0])):
        if k < 255:
            ids[marks[k]] = k + 1
    return ids


def guess_masks(p: Picture) -> None:
    """Labelled fires get the pixels that look like flame, where colour tells: for training, no truth."""
    if p.name.startswith("abonia"):
        return  # loose boxes around the glow of lamps, too
    h, w = p.image.shape[:2]
    marks = []
    for cls, *box in p.boxes:
        mark = np.zeros((h, w), bool)
        x1, y1, x2, y2 = np.clip(np.round(box), 0, (w, h, w, h)).astype(int)
        if cls == 0 and min(x2 - x1, y2 - y1) >= 4:
            cover = flame_cover(p.image[y1:y2, x1:x2]) > 0.4
            if 0.08 < cover.mean() < 0.9:
                mark[y1:y2, x1:x2] = cover
        marks.append(mark)
    p.ids = identify(p.boxes, marks, h, w)


def read_split(root: Path, split: str, sets: tuple[str, ...] = RGB_SETS) -> list[Picture]:
    """All pictures of one split of the fire data (root holds manifest.csv and splits/)."""
    rows = {r["path"]: r for r in csv.DictReader((root / "manifest.csv").open())}
    out = []
    for line in (root / "splits" / f"{split}.txt").read_text().split():
        if line.split("/")[0] not in sets:
            continue
        img = cv2.imread(str(root / line))
        label = root / line.replace("/images/", "/labels/").replace(".jpg", ".txt")
        row = rows[line]
        boxes, _ = read_labels(label, img.shape[1], img.shape[0])
        out.append(Picture(img, boxes, row["smoke_labelled"] == "yes", row["cluster"], line))
    return out


def read_yolo(folder: Path) -> list[Picture]:
    """A folder with images/*.jpg or *.png and labels/*.txt, both classes labelled."""
    out = []
    for path in sorted(p for p in (folder / "images").iterdir() if p.suffix in (".jpg", ".png")):
        img = cv2.imread(str(path))
        boxes, ids = read_labels(folder / "labels" / f"{path.stem}.txt", img.shape[1], img.shape[0])
        out.append(Picture(img, boxes, True, folder.name, f"{folder.name}/{path.name}", ids))
    return out


def draw(count: int, seed: int, cache: Path | None = None) -> list[Picture]:
    """`count` procedural pictures; kept in `cache` (npz) between runs."""
    if cache is not None and cache.exists():
        with np.load(cache) as z:
            images, boxes, ends, ids = z["images"], z["boxes"], z["ends"], z["ids"]
    else:
        scenes = [synth.scene(np.random.default_rng([seed, i])) for i in range(count)]
        images = np.stack([s[0] for s in scenes])
        boxes = np.concatenate([s[1] for s in scenes])
        ends = np.cumsum([len(s[1]) for s in scenes])
        ids = np.stack([identify(s[1], s[2], synth.SIDE, synth.SIDE) for s in scenes])
        if cache is not None:
            np.savez(cache, images=images, boxes=boxes, ends=ends, ids=ids)
    parts = np.split(boxes, ends[:-1])
    return [Picture(i, b, True, "synth", f"synth/{seed}/{k}", m) for k, (i, b, m) in enumerate(zip(images, parts, ids))]


def letterbox(image: np.ndarray, side: int) -> tuple[np.ndarray, float, int, int]:
    """Fit into side x side with grey bars; returns picture, scale and left, top offset in px."""
    h, w = image.shape[:2]
    s = min(side / h, side / w)
    nh, nw = round(h * s), round(w * s)
    out = np.full((side, side, 3), GREY, np.uint8)
    x, y = (side - nw) // 2, (side - nh) // 2
    mode = cv2.INTER_AREA if s < 1 else cv2.INTER_LINEAR
    out[y : y + nh, x : x + nw] = cv2.resize(image, (nw, nh), interpolation=mode)
    return out, s, x, y


class Canvas:
    """A square picture under construction, side px (a multiple of 32), with boxes and validity."""

    def __init__(self, side: int) -> None:
        self.side = side
        self.image = np.full((side, side, 3), GREY, np.uint8)
        self.boxes: list[np.ndarray] = []
        self.valid = np.full((side // 8, side // 8), 3, np.uint8)
        self.ids = np.zeros((side, side), np.uint8)

    def forbid(self, box: np.ndarray, bits: int) -> None:
        """Stop judging the classes `bits` inside the box (px)."""
        x1, y1, x2, y2 = np.clip(np.r_[np.floor(box[:2] / 8), np.ceil(box[2:] / 8)], 0, None).astype(int)
        self.valid[y1 : y2 + 1, x1 : x2 + 1] &= 3 ^ bits

    def place(self, p: Picture, scale: float, dx: float, dy: float, window: tuple[int, int, int, int]) -> None:
        """Draw p scaled, its corner at (dx, dy), only inside window (x1, y1, x2, y2), all in px."""
        x1, y1, x2, y2 = window
        m = np.array([[scale, 0, dx - x1], [0, scale, dy - y1]], np.float32)
        image, ids = p.image, np.zeros((y2 - y1, x2 - x1), np.uint8)
        if p.ids is not None:
            # Pixel k spans k to k + 1: its middle goes where the middle goes.
            middle = m + np.array([[0, 0, (scale - 1) / 2]] * 2, np.float32)
            ids = cv2.warpAffine(p.ids, middle, ids.shape[::-1], flags=cv2.INTER_NEAREST)
        if scale < 0.6:  # area-average first, so that shrinking keeps small flames clean
            image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            m[0, 0] = m[1, 1] = 1
        cv2.warpAffine(image, m, (x2 - x1, y2 - y1), self.image[y1:y2, x1:x2], cv2.INTER_LINEAR,
                       cv2.BORDER_CONSTANT, (GREY, GREY, GREY))
        if not p.smoke:
            self.forbid(np.array(window, np.float32), 2)
        new = np.zeros(256, np.uint8)
        for k, box in enumerate(p.boxes):
            full = box[1:] * scale + (dx, dy, dx, dy)
            part = np.r_[np.maximum(full[:2], (x1, y1)), np.minimum(full[2:], (x2, y2))]
            w, h = part[2:] - part[:2]
            if w < 1 or h < 1:
                continue
            seen = w * h / np.prod(full[2:] - full[:2])
            if seen < 0.25 or min(w, h) < 4:
                self.forbid(part, 1 << int(box[0]))
            else:
                self.boxes.append(np.r_[box[0], part])
                if k < 255 and len(self.boxes) < 256:
                    new[k + 1] = len(self.boxes)
        self.ids[y1:y2, x1:x2] = new[ids]


def flame_cover(crop: np.ndarray) -> np.ndarray:
    """How much each pixel of a labelled fire crop looks like flame, 0..1 [h, w] (red first, bright)."""
    b, g, r = (crop[..., i].astype(np.float32) for i in range(3))
    warm = np.clip((r - b) / 60, 0, 1) * np.clip((r - 110) / 70, 0, 1)
    white = np.clip((np.minimum(r, g) - 195) / 40, 0, 1)
    return cv2.GaussianBlur(np.maximum(warm, white), (0, 0), 0.8)


# How often a sample is of each kind; kinds that lack pictures leave their share to the others.
SHARES = {"extra": 0.20, "drawn": 0.08, "paste": 0.12, "mosaic": 0.18, "single": 0.42}


class Mixer:
    """Draws augmented training samples from the pools. Flames are pasted and lamps added in visible
    light only: to a thermal camera a lamp is as warm as it looks."""

    def __init__(self, real: list[Picture], drawn: list[Picture], extra: list[Picture], side: int,
                 visible: bool = True, shares: dict[str, float] = SHARES) -> None:
        self.side, self.visible = side, visible
        self.drawn, self.extra = drawn, extra
        by_set: dict[str, dict[str, list[Picture]]] = defaultdict(lambda: defaultdict(list))
        for p in real:
            by_set[p.name.split("/")[0]][p.clip].append(p)
        self.sets = [(name, list(clips.values())) for name, clips in by_set.items()]
        weight = {"continuous_fire6": 0.62, "abonia_cctv": 0.18, "dfire_none99": 0.2}
        self.set_p = np.array([weight.get(n, 0.1) for n, _ in self.sets])
        self.set_p /= self.set_p.sum()
        # Long clips count more than stills, but far less than by their length.
        self.clip_p = [np.array([len(c) ** 0.4 for c in clips]) for _, clips in self.sets]
        self.clip_p = [p / p.sum() for p in self.clip_p]
        self.calm = [p for p in real + drawn if len(p.boxes) == 0 and p.smoke]
        self.fires = [p for p in real if (p.boxes[:, 0] == 0).any() and not p.name.startswith("abonia")]
        there = {"extra": extra, "drawn": drawn, "paste": visible and self.calm and self.fires,
                 "mosaic": real, "single": real}
        self.kinds = [k for k in shares if there[k]]
        self.kind_p = np.array([shares[k] for k in self.kinds])
        self.kind_p /= self.kind_p.sum()

    def real(self, rng: Generator) -> Picture:
        i = rng.choice(len(self.sets), p=self.set_p)
        clips = self.sets[i][1]
        clip = clips[rng.choice(len(clips), p=self.clip_p[i])]
        return clip[rng.integers(len(clip))]

    def single(self, rng: Generator, c: Canvas, p: Picture, low: float, high: float) -> None:
        """One picture, `low..high` times the canvas, anywhere that keeps part of it in view."""
        h, w = p.image.shape[:2]
        s = self.side / max(h, w) * np.exp(rng.uniform(np.log(low), np.log(high)))
        room = np.array([self.side - w * s, self.side - h * s])
        dx, dy = room * rng.uniform(0, 1, 2)
        c.place(p, float(s), float(dx), float(dy), (0, 0, self.side, self.side))

    def tile(self, rng: Generator, c: Canvas, p: Picture) -> None:
        """A tile at about full resolution out of a large frame, as the service cuts it."""
        s = float(np.exp(rng.uniform(np.log(0.75), np.log(1.5))))
        h, w = p.image.shape[:2]
        if len(p.boxes) and rng.random() < 0.7:
            box = p.boxes[rng.integers(len(p.boxes)), 1:] * s
            corner = (box[:2] + box[2:]) / 2 - rng.uniform(0.1, 0.9, 2) * self.side
        else:
            corner = rng.uniform(0, 1, 2) * np.maximum((w * s - self.side, h * s - self.side), 0)
        corner = np.clip(corner, 0, np.maximum((w * s - self.side, h * s - self.side), 0))
        c.place(p, s, float(-corner[0]), float(-corner[1]), (0, 0, self.side, self.side))

    def mosaic(self, rng: Generator, c: Canvas) -> None:
        """Four pictures around a random centre, so that objects get small."""
        n = self.side
        cx, cy = (rng.uniform(0.3, 0.7, 2) * n / 8).astype(int) * 8
        for x1, y1, x2, y2 in ((0, 0, cx, cy), (cx, 0, n, cy), (0, cy, cx, n), (cx, cy, n, n)):
            p = self.real(rng) if rng.random() < 0.75 or not self.drawn else self.drawn[rng.integers(len(self.drawn))]
            h, w = p.image.shape[:2]
            s = max((x2 - x1) / w, (y2 - y1) / h) * rng.uniform(0.7, 1.3)
            dx = x1 + (x2 - x1 - w * s) * rng.uniform(0, 1)
            dy = y1 + (y2 - y1 - h * s) * rng.uniform(0, 1)
            c.place(p, float(s), float(dx), float(dy), (x1, y1, x2, y2))

    def paste(self, rng: Generator, c: Canvas) -> None:
        """Labelled flames, cut out by colour and shrunk to 7..120 px, onto a calm background."""
        self.single(rng, c, self.calm[rng.integers(len(self.calm))], 1.0, 2.0)
        for _ in range(int(rng.integers(1, 6))):
            p = self.real(rng)
            for _ in range(8):
                if (p.boxes[:, 0] == 0).any() and not p.name.startswith("abonia"):
                    break
                p = self.real(rng)
            else:
                p = self.fires[rng.integers(len(self.fires))]
            rows = p.boxes[p.boxes[:, 0] == 0]
            x1, y1, x2, y2 = np.clip(rows[rng.integers(len(rows)), 1:], 0, None).astype(int)
            crop = p.image[y1:y2, x1:x2]
            if min(crop.shape[:2]) < 8:
                continue
            cover = flame_cover(crop)
            if cover.mean() < 0.08:
                continue
            size = float(np.exp(rng.uniform(np.log(7), np.log(120)))) / max(crop.shape[:2])
            mode = cv2.INTER_AREA if size < 1 else cv2.INTER_LINEAR
            crop = cv2.resize(crop, None, fx=size, fy=size, interpolation=mode)
            cover = cv2.resize(cover, crop.shape[1::-1], interpolation=mode)
            if rng.random() < 0.5:
                crop, cover = crop[:, ::-1], cover[:, ::-1]
            h, w = cover.shape
            if h >= self.side or w >= self.side or min(h, w) < 4:
                continue
            x, y = int(rng.integers(0, self.side - w)), int(rng.integers(0, self.side - h))
            box = synth.extent(cover, 0.4)
            if box is None or min(box[2:] - box[:2]) < 4:
                continue
            view = c.image[y : y + h, x : x + w]
            mix = np.clip(cover * 1.3, 0, 1)[..., None]
            view[:] = (view * (1 - mix) + crop * mix).astype(np.uint8)
            c.boxes.append(np.r_[0, box + (x, y, x, y)])
            if len(c.boxes) < 256:
                c.ids[y : y + h, x : x + w][cover > 0.4] = len(c.boxes)

    def sample(self, rng: Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Picture [side, side, 3] uint8 BGR, boxes [n, 5] px, valid [side/8, side/8] uint8, ids [side, side]."""
        c = Canvas(self.side)
        match self.kinds[rng.choice(len(self.kinds), p=self.kind_p)]:
            case "extra":
                p = self.extra[rng.integers(len(self.extra))]
                self.tile(rng, c, p) if rng.random() < 0.75 else self.single(rng, c, p, 0.9, 1.3)
            case "drawn":
                self.single(rng, c, self.drawn[rng.integers(len(self.drawn))], 0.7, 1.6)
            case "paste":
                self.paste(rng, c)
            case "mosaic":
                self.mosaic(rng, c)
            case _:
                self.single(rng, c, self.real(rng), 0.6, 1.4)
        if self.visible and rng.random() < 0.2:
            lamps(rng, c.image)
        img = photometric(rng, c.image)
        if not self.visible and rng.random() < 0.5:  # white is hot: what a camera without a palette gives
            img = cv2.cvtColor(cv2.cvtColor(img, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
        boxes = np.array(c.boxes, np.float32).reshape(-1, 5)
        valid, ids = c.valid, c.ids
        if rng.random() < 0.5:
            # Cell (i) looks at px 8 i, so the flipped map is off by less than one cell.
            img, valid, ids = img[:, ::-1], valid[:, ::-1], ids[:, ::-1]
            boxes[:, [1, 3]] = self.side - boxes[:, [3, 1]]
        return np.ascontiguousarray(img), boxes, np.ascontiguousarray(valid), np.ascontiguousarray(ids)


def lamps(rng: Generator, img: np.ndarray) -> None:
    """Add one to six unlabelled lamps or glints in place: small, round, smooth, nearly white."""
    h, w = img.shape[:2]
    for _ in range(int(rng.integers(1, 7))):
        r = float(np.exp(rng.uniform(np.log(1.2), np.log(9))))
        n = int(3 * r) + 1
        if 2 * n >= min(h, w):
            continue
        x, y = int(rng.integers(n, w - n)), int(rng.integers(n, h - n))
        gy, gx = np.mgrid[-n:n, -n:n].astype(np.float32)
        spot = np.exp(-((gx * rng.uniform(0.4, 1.0)) ** 2 + gy**2) / (r * r)) * rng.uniform(0.8, 2.5)
        tint = np.array([rng.uniform(110, 255), rng.uniform(200, 255), 255], np.float32)
        view = img[y - n : y + n, x - n : x + n]
        view[:] = np.minimum(view + spot[..., None] * tint, 255).astype(np.uint8)


def photometric(rng: Generator, img: np.ndarray) -> np.ndarray:
    """Brightness, contrast, hue, saturation, blur, noise and JPEG damage; uint8 in and out."""
    if rng.random() < 0.5:
        hsv = cv2.cvtColor(img, cv2.COLOR_BGR2HSV)
        hue = (np.arange(256) + rng.integers(-5, 6)) % 180
        sat = np.clip(np.arange(256) * rng.uniform(0.6, 1.4), 0, 255)
        val = np.clip(np.arange(256) * rng.uniform(0.65, 1.35), 0, 255)
        table = np.stack((hue, sat, val), -1).astype(np.uint8)[None]
        img = cv2.cvtColor(cv2.LUT(hsv, table), cv2.COLOR_HSV2BGR)
    if rng.random() < 0.4:
        ramp = np.arange(256) / 255
        ramp = ramp ** np.exp(rng.uniform(-0.4, 0.4)) * rng.uniform(0.85, 1.15) + rng.uniform(-0.06, 0.06)
        img = cv2.LUT(img, np.clip(ramp * 255, 0, 255).astype(np.uint8))
    if rng.random() < 0.2:
        img = cv2.GaussianBlur(img, (0, 0), rng.uniform(0.4, 1.6))
    if rng.random() < 0.15:
        grain = rng.integers(-12, 13, img.shape, dtype=np.int16)
        img = np.clip(img + grain, 0, 255).astype(np.uint8)
    if rng.random() < 0.3:
        ok, data = cv2.imencode(".jpg", img, (cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 90))))
        img = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return img


class Batches(IterableDataset):
    """Endless seeded batches: images [B, 3, S, S] uint8, boxes [B, M, 5] (class -1 = none), valid, ids."""

    def __init__(self, mixer: Mixer, batch: int, seed: int, start: int = 0) -> None:
        self.mixer, self.batch, self.seed, self.start = mixer, batch, seed, start

    def __iter__(self) -> Iterator[tuple[torch.Tensor, ...]]:
        cv2.setNumThreads(0)
        info = torch.utils.data.get_worker_info()
        step, stride = self.start + (info.id if info else 0), info.num_workers if info else 1
        while True:
            rng = np.random.default_rng([self.seed, step])
            samples = [self.mixer.sample(rng) for _ in range(self.batch)]
            most = max(1, max(len(s[1]) for s in samples))
            boxes = np.full((self.batch, most, 5), -1, np.float32)
            for i, s in enumerate(samples):
                boxes[i, : len(s[1])] = s[1]
            images = torch.from_numpy(np.stack([s[0] for s in samples])).permute(0, 3, 1, 2)
            valid, ids = (torch.from_numpy(np.stack([s[k] for s in samples])) for k in (2, 3))
            yield images, torch.from_numpy(boxes), valid, ids
            step += stride
