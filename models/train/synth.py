"""Procedural aerial-look pictures with flames, smoke and lookalikes (domain randomisation).

Every picture is SIDE x SIDE uint8 BGR. Boxes are rows of (class, x1, y1, x2, y2) in px;
class 0 is fire, 1 is smoke; a mask [SIDE, SIDE] per box says which pixels are it. Nothing here is
photographed: all of it is drawn from a seed.

    python -m train.synth --out SHEET.png                   # a look at some
    python -m train.synth --dataset DIR --count 200 --seed 20000   # pictures with outlines as labels
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator

from . import masks

SIDE = 416  # px
# Ground colours, BGR: grass, dry grass, soil, dark soil, asphalt, concrete, forest, sand, water, burnt
GROUND = np.array(
    [(60, 105, 75), (95, 150, 165), (70, 95, 130), (45, 60, 75), (85, 85, 85), (165, 170, 172),
     (38, 70, 48), (140, 180, 200), (120, 95, 60), (35, 38, 40)], np.float32)
# Things that are red, orange, yellow or white but do not burn, BGR
LOUD = np.array(
    [(40, 45, 170), (35, 90, 225), (30, 130, 245), (40, 200, 240), (245, 245, 245), (60, 60, 210),
     (50, 70, 150), (200, 120, 40)], np.float32)


def noise(rng: Generator, h: int, w: int, cell: int, octaves: int = 4) -> np.ndarray:
    """Smooth noise [h, w] around 0, standard deviation about 1; `cell` px is the coarsest grain."""
    out = np.zeros((h, w), np.float32)
    gain = 1.0
    for _ in range(octaves):
        small = rng.standard_normal((h // cell + 3, w // cell + 3)).astype(np.float32)
        out += gain * cv2.resize(small, (w, h), interpolation=cv2.INTER_CUBIC)
        cell, gain = max(cell // 3, 1), gain * 0.6
    return out / (out.std() + 1e-6)


def ground(rng: Generator) -> np.ndarray:
    """Textured terrain [SIDE, SIDE, 3] float32 made of two or three materials."""
    img = np.empty((SIDE, SIDE, 3), np.float32)
    img[:] = GROUND[rng.integers(len(GROUND))]
    for _ in range(rng.integers(1, 3)):
        mask = 1 / (1 + np.exp(-4 * (noise(rng, SIDE, SIDE, int(rng.integers(50, 250)), 3) - rng.uniform(-0.5, 1))))
        img += mask[..., None] * (GROUND[rng.integers(len(GROUND))] - img)
    img *= 1 + rng.uniform(0.04, 0.22) * noise(rng, SIDE, SIDE, int(rng.integers(4, 60)))[..., None]
    img += rng.uniform(0, 8) * rng.standard_normal((SIDE, SIDE, 1)).astype(np.float32)
    if rng.random() < 0.25:  # ploughed rows
        a, f = rng.uniform(0, np.pi), rng.uniform(0.1, 0.9)
        y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
        img *= 1 + 0.12 * np.sin((x * np.cos(a) + y * np.sin(a)) * f)[..., None]
    return img


def quad(rng: Generator, w: float, h: float, at: np.ndarray | None = None) -> np.ndarray:
    """Corners [4, 2] of a turned, slightly sheared rectangle of w x h px."""
    centre = rng.uniform(0, SIDE, 2) if at is None else at
    a = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a) * 0.7, np.cos(a) * 0.7]])
    return (np.array([[-w, -h], [w, -h], [w, h], [-w, h]]) / 2) @ turn.T + centre


def fill(img: np.ndarray, poly: np.ndarray, colour: np.ndarray) -> None:
    cv2.fillPoly(img, [np.round(poly * 8).astype(np.int32)], colour.tolist(), cv2.LINE_AA, 3)


def furnish(rng: Generator, img: np.ndarray) -> None:
    """Roads, roofs, trees, vehicles, glints and loud flat things, drawn in place."""
    for _ in range(rng.poisson(0.5)):  # roads
        pts = np.cumsum(rng.normal(0, 130, (5, 2)), 0) + rng.uniform(0, SIDE, 2)
        width = int(rng.integers(5, 45))
        grey = float(rng.uniform(60, 170))
        cv2.polylines(img, [pts.astype(np.int32)], False, (grey, grey, grey), width, cv2.LINE_AA)
        if rng.random() < 0.5:
            cv2.polylines(img, [pts.astype(np.int32)], False, (220, 225, 225), 1, cv2.LINE_AA)
    for _ in range(rng.poisson(1.2)):  # roofs, half of them red
        w, h = rng.uniform(15, 130, 2)
        base = np.array([50, 65, 160], np.float32) if rng.random() < 0.5 else np.full(3, rng.uniform(50, 200), np.float32)
        base = base * rng.uniform(0.6, 1.35, 3)
        p = quad(rng, w, h)
        fill(img, p + rng.uniform(2, 10), np.full(3, 25.0))
        fill(img, p, base)
        fill(img, np.stack([p[0], p[1], (p[1] + p[2]) / 2, (p[0] + p[3]) / 2]), base * rng.uniform(0.6, 0.9))
    for _ in range(rng.poisson(4)):  # trees
        c, r = rng.uniform(0, SIDE, 2), rng.uniform(4, 35)
        green = np.array([35, 80, 50]) * rng.uniform(0.5, 1.4)
        for _ in range(9):
            o = rng.normal(0, r * 0.45, 2)
            cv2.circle(img, tuple((c + o).astype(int).tolist()), int(r * rng.uniform(0.25, 0.6)) + 1,
                       (green * rng.uniform(0.7, 1.4)).tolist(), -1, cv2.LINE_AA)
    for _ in range(rng.poisson(1.2)):  # vehicles
        s, at = rng.uniform(5, 40), rng.uniform(0, SIDE, 2)
        body = LOUD[rng.integers(len(LOUD))] * rng.uniform(0.5, 1.05)
        a = rng.bit_generator.state
        fill(img, quad(rng, s, s * 0.45, at) + 1.5, np.full(3, 20.0))
        rng.bit_generator.state = a
        fill(img, quad(rng, s, s * 0.45, at), body)
        rng.bit_generator.state = a
        fill(img, quad(rng, s * 0.35, s * 0.38, at), np.array([60.0, 50, 45]))
    for _ in range(rng.poisson(0.8)):  # flat loud things: tarps, cones, signs, people in vests
        s = rng.uniform(3, 40)
        c = LOUD[rng.integers(len(LOUD))] * rng.uniform(0.6, 1.08)
        if rng.random() < 0.5:
            fill(img, quad(rng, s, s * rng.uniform(0.3, 1)), c)
        else:
            cv2.circle(img, tuple(rng.integers(0, SIDE, 2).tolist()), int(s / 2) + 1, c.tolist(), -1, cv2.LINE_AA)
    for _ in range(rng.poisson(0.7)):  # sun glints and lamps: round, smooth, no tongues
        at, r = rng.uniform(0, SIDE, 2), rng.uniform(1.5, 22)
        y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
        d2 = ((x - at[0]) / rng.uniform(0.5, 3)) ** 2 + (y - at[1]) ** 2
        tint = np.array([rng.uniform(150, 255), rng.uniform(205, 255), 255], np.float32)
        img += np.exp(-d2 / (r * r))[..., None] * tint * rng.uniform(0.7, 2)


def flame(rng: Generator, h: int, w: int) -> tuple[np.ndarray, np.ndarray]:
    """One flickering fire of about h x w px: colour [h, w, 3] (BGR float32) and cover [h, w] 0..1."""
    y, x = np.mgrid[:h, :w].astype(np.float32)
    up = (h - 1 - y) / max(h - 1, 1)  # 0 at the base, 1 at the top
    heat = np.zeros((h, w), np.float32)
    count = int(rng.integers(1, 3 + min(w // 8, 6)))
    for _ in range(count):
        tall = rng.uniform(0.45, 1.0)
        t = np.clip(up / tall, 0, 1)
        sway = rng.uniform(-0.25, 0.25) * t + 0.08 * np.sin(t * rng.uniform(3, 9) + rng.uniform(0, 6.3)) * t
        mid = (rng.uniform(0.25, 0.75) + sway) * w
        wide = w * rng.uniform(0.15, 0.45) * (1 - t) ** rng.uniform(0.5, 1.1) + 0.4
        heat = np.maximum(heat, np.exp(-(((x - mid) / wide) ** 2)) * (1 - t ** rng.uniform(2, 5)) * rng.uniform(0.75, 1.1))
    if min(h, w) > 10:
        heat *= 1 + 0.18 * noise(rng, h, w, max(min(h, w) // 3, 3), 2)
    heat = np.clip(heat * rng.uniform(0.9, 1.4), 0, 1.2)
    red = np.array([rng.uniform(0, 40), rng.uniform(30, 100), rng.uniform(190, 255)], np.float32)
    orange = np.array([rng.uniform(0, 70), rng.uniform(110, 185), 255], np.float32)
    core = np.array([rng.uniform(90, 250), rng.uniform(220, 255), 255], np.float32)
    low = np.clip((heat - 0.2) / rng.uniform(0.2, 0.4), 0, 1)[..., None]
    high = np.clip((heat - rng.uniform(0.45, 0.75)) / 0.3, 0, 1)[..., None]
    colour = red + low * (orange - red)
    colour = colour + high * (core - colour)
    return colour, np.clip((heat - 0.08) / rng.uniform(0.12, 0.4), 0, 1)


def extent(cover: np.ndarray, level: float) -> np.ndarray | None:
    """Box (x1, y1, x2, y2) of cover > level, or None."""
    ys, xs = np.where(cover > level)
    return None if len(xs) < 3 else np.array([xs.min(), ys.min(), xs.max() + 1, ys.max() + 1], np.float32)


Drawn = tuple[np.ndarray | None, np.ndarray]  # box, mask


def burn(rng: Generator, img: np.ndarray, size: float) -> Drawn:
    """Draw a fire (one or several flames side by side) about `size` px wide."""
    total = np.zeros((SIDE, SIDE), np.float32)
    at = rng.uniform(0, SIDE, 2)
    parts = int(rng.integers(1, 4)) if size > 14 else 1
    opaque = rng.uniform(0.75, 1.0)
    glow = size * rng.uniform(0.5, 1.4)
    if rng.random() < 0.7:
        y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
        halo = np.exp(-((x - at[0]) ** 2 + 1.6 * (y - at[1]) ** 2) / (glow * glow))
        img += halo[..., None] * np.array([10, 60, 130], np.float32) * rng.uniform(0.1, 0.9)
    for k in range(parts):
        w = int(max(4, size / parts * rng.uniform(0.8, 1.4)))
        h = int(max(4, w * rng.uniform(0.6, 2.2)))
        colour, cover = flame(rng, h, w)
        x0 = int(at[0] + (k - parts / 2) * size / parts)
        y0 = int(at[1] - h + rng.normal(0, size * 0.08))
        a, b = max(-y0, 0), max(-x0, 0)
        c, d = min(SIDE - y0, h), min(SIDE - x0, w)
        if a >= c or b >= d:
            continue
        view = np.s_[y0 + a : y0 + c, x0 + b : x0 + d]
        alpha = cover[a:c, b:d]
        mix = (alpha * opaque)[..., None]
        img[view] = img[view] * (1 - mix) + colour[a:c, b:d] * mix * rng.uniform(0.9, 1.15)
        total[view] = np.maximum(total[view], alpha)
    return extent(total, 0.35), total > 0.35


def fume(rng: Generator, img: np.ndarray, at: np.ndarray, size: float) -> Drawn:
    """Draw a smoke plume that drifts up from `at`; `size` px is its first radius."""
    clear = np.ones((SIDE, SIDE), np.float32)
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    drift = np.array([rng.uniform(-1.0, 1.0), -rng.uniform(0.5, 1.2)])
    p, r = at.astype(np.float64), size
    strength = rng.uniform(0.15, 0.6)
    for _ in range(int(rng.integers(5, 13))):
        clear *= 1 - strength * np.exp(-((x - p[0]) ** 2 + (y - p[1]) ** 2) / (r * r))
        p = p + drift * r * 0.7 + rng.normal(0, r * 0.15, 2)
        r *= rng.uniform(1.02, 1.25)
        strength *= rng.uniform(0.85, 1.0)
    cover = np.clip((1 - clear) * (1 + 0.3 * noise(rng, SIDE, SIDE, max(int(size * 1.5), 6), 4)), 0, 0.95)
    grey = np.full(3, rng.uniform(60, 225), np.float32) * rng.uniform(0.95, 1.05, 3)
    shade = 1 + 0.08 * noise(rng, SIDE, SIDE, max(int(size), 4), 3)[..., None]
    img += cover[..., None] * (grey * shade - img)
    return extent(cover, 0.2), cover > 0.2


def scene(rng: Generator, fires: bool | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One picture [SIDE, SIDE, 3] uint8, its boxes [n, 5] and masks [n, SIDE, SIDE]; fires=False draws a
    negative."""
    img = ground(rng)
    furnish(rng, img)
    np.clip(img, 0, 255, img)
    if rng.random() < 0.12:  # sky above a horizon
        line = int(rng.uniform(0.05, 0.5) * SIDE)
        sky = np.array([rng.uniform(150, 255), rng.uniform(140, 230), rng.uniform(120, 235)], np.float32)
        img[:line] = sky * np.linspace(1.0, 0.85, line, dtype=np.float32)[:, None, None]
    img *= rng.uniform(0.2, 0.7) if rng.random() < 0.3 else rng.uniform(0.8, 1.25)
    boxes: list[np.ndarray] = []
    marks: list[np.ndarray] = []
    if fires or (fires is None and rng.random() < 0.65):
        for _ in range(int(rng.integers(1, 5))):
            size = float(np.exp(rng.uniform(np.log(5), np.log(110))))
            smoke_first = rng.random() < 0.5
            at = rng.uniform(0, SIDE, 2)
            plume = None, np.zeros(0)
            if rng.random() < 0.35 and smoke_first:
                plume = fume(rng, img, at, size * rng.uniform(0.3, 0.8))
            fire = burn(rng, img, size)
            box = fire[0]
            if box is not None and plume[0] is None and rng.random() < 0.3:
                top = np.array([(box[0] + box[2]) / 2, box[1]])
                plume = fume(rng, img, top, (box[2] - box[0]) * rng.uniform(0.3, 0.8) + 2)
            seen = [(c, b, m) for c, (b, m) in enumerate((fire, plume)) if b is not None]
            boxes += [np.r_[c, b] for c, b, _ in seen]
            marks += [m for _, _, m in seen]
    if rng.random() < 0.25:  # haze over everything
        img += rng.uniform(0.05, 0.35) * (rng.uniform(140, 220) - img)
    img += rng.uniform(0, 5) * rng.standard_normal(img.shape).astype(np.float32)
    if rng.random() < 0.5:
        img = cv2.GaussianBlur(img, (0, 0), rng.uniform(0.3, 1.2))
    out = np.clip(img, 0, 255).astype(np.uint8)
    return out, np.array(boxes, np.float32).reshape(-1, 5), np.array(marks, bool).reshape(-1, SIDE, SIDE)


def write(folder: Path, count: int, seed: int) -> None:
    """`count` pictures as a YOLO folder whose labels are outlines; the same as `data.draw` gives."""
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for k in range(count):
        img, boxes, marks = scene(np.random.default_rng([seed, k]))
        cv2.imwrite(str(folder / "images" / f"{k:06}.png"), img)
        lines = [masks.label(int(box[0]), mask) for box, mask in zip(boxes, marks)]
        (folder / "labels" / f"{k:06}.txt").write_text("".join(lines))


def main() -> None:
    ap = argparse.ArgumentParser(description="Write a sheet of drawn pictures to look at, or a data set.")
    ap.add_argument("--dataset", type=Path, help="write labelled pictures into this folder instead")
    ap.add_argument("--count", type=int, default=200)
    ap.add_argument("--out", type=Path, default=Path("synth.png"))
    ap.add_argument("--seed", type=int, default=0)
    args = ap.parse_args()
    if args.dataset:
        write(args.dataset, args.count, args.seed)
        return
    rng = np.random.default_rng(args.seed)
    tiles = []
    for _ in range(12):
        img, boxes, _ = scene(rng)
        for c, x1, y1, x2, y2 in boxes.astype(int).tolist():
            cv2.rectangle(img, (x1, y1), (x2, y2), (255, 128, 0) if c else (0, 255, 0), 1)
        tiles.append(img)
    cv2.imwrite(str(args.out), np.vstack([np.hstack(tiles[i : i + 4]) for i in (0, 4, 8)]))


if __name__ == "__main__":
    main()
