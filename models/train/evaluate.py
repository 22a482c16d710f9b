"""Score the ONNX file (through ONNX Runtime) on a split, drawn pictures or simulated frames.

    python -m train.evaluate --data ../../shared/data/fire --split test
    python -m train.evaluate --frames DIR          # YOLO folder of large frames, cut into tiles
    python -m train.evaluate --drawn 300           # procedural pictures with an unused seed
    python -m train.evaluate --data ... --split val --pick   # choose the threshold
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from . import data, metrics
from .model import BINS, INPUT, cells

SIZES = {"under 32 px": (0.0, 32.0), "32 to 96 px": (32.0, 96.0), "over 96 px": (96.0, np.inf)}


class Detector:
    """The shipped file; pictures in, detections in px of the picture out."""

    def __init__(self, path: Path) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self.meta = self.session.get_modelmeta().custom_metadata_map
        self.names = list(json.loads(self.meta["names"]).values())
        self.mean, self.std = (np.array(json.loads(self.meta[k]), np.float32) for k in ("mean", "std"))
        self.input = self.session.get_inputs()[0].name
        grid = cells(INPUT, INPUT, (8, 16, 32), 0.5) if self.meta["family"] == "nanodet" else cells(INPUT, INPUT)
        self.centres, self.strides = (part.numpy() for part in grid)

    def square(self, image: np.ndarray) -> metrics.Found:
        """A 416 x 416 BGR uint8 picture."""
        x = ((image.astype(np.float32) - self.mean) / self.std).transpose(2, 0, 1)[None]
        out = [y[0] for y in self.session.run(None, {self.input: np.ascontiguousarray(x)})]
        nc = len(self.names)
        if self.meta["family"] == "yolov8-seg":
            rows = out[0].T
            boxes = np.concatenate((rows[:, :2] - rows[:, 2:4] / 2, rows[:, :2] + rows[:, 2:4] / 2), 1)
            return metrics.unpack(rows[:, 4 : 4 + nc], np.clip(boxes, 0, INPUT))
        y = np.concatenate((np.concatenate(out[:3]), np.concatenate(out[3:])), 1) if len(out) == 6 else out[0]
        bins = y[:, nc:].reshape(-1, 4, BINS)
        bins = np.exp(bins - bins.max(-1, keepdims=True))
        side = (bins / bins.sum(-1, keepdims=True)) @ np.arange(BINS, dtype=np.float32) * self.strides[:, None]
        boxes = np.concatenate((self.centres - side[:, :2], self.centres + side[:, 2:]), 1)
        return metrics.unpack(y[:, :nc], np.clip(boxes, 0, INPUT))

    def fitted(self, image: np.ndarray) -> metrics.Found:
        """Any picture, letterboxed."""
        canvas, s, x, y = data.letterbox(image, INPUT)
        found = self.square(canvas)
        found.boxes = (found.boxes - (x, y, x, y)) / s
        return found

    def tiled(self, image: np.ndarray, lap: int = 64) -> metrics.Found:
        """A large frame: tiles of 416 px that overlap by at least `lap` px, and the whole frame."""
        h, w = image.shape[:2]
        parts = [self.fitted(image)]
        for y in starts(h, lap):
            for x in starts(w, lap):
                tile = np.full((INPUT, INPUT, 3), data.GREY, np.uint8)
                cut = image[y : y + INPUT, x : x + INPUT]
                tile[: cut.shape[0], : cut.shape[1]] = cut
                found = self.square(tile)
                found.boxes = found.boxes + (x, y, x, y)
                parts.append(found)
        boxes, score, cls = (np.concatenate([getattr(p, k) for p in parts]) for k in ("boxes", "score", "cls"))
        keep = np.concatenate([np.flatnonzero(cls == c)[metrics.nms(boxes[cls == c], score[cls == c], 0.5)]
                               for c in range(len(self.names))])
        keep = keep[np.argsort(-score[keep], kind="stable")]
        return metrics.Found(boxes[keep], score[keep], cls[keep])


def starts(length: int, lap: int) -> list[int]:
    """Tile offsets (px) that cover `length` px with tiles of 416 px."""
    if length <= INPUT:
        return [0]
    count = int(np.ceil((length - lap) / (INPUT - lap)))
    return [round(i * (length - INPUT) / (count - 1)) for i in range(count)]


def at_threshold(found: list[metrics.Found], truth: list[np.ndarray], cls: int, threshold: float) -> dict[str, float]:
    """Precision, recall and F1 of one class for detections of at least `threshold`."""
    score, hit, total = metrics.match(found, truth, cls)
    tp = int((hit & (score >= threshold)).sum()) if len(score) else 0
    n = int((score >= threshold).sum()) if len(score) else 0
    p, r = tp / max(n, 1), tp / max(total, 1)
    return {"precision": p, "recall": r, "f1": 2 * p * r / max(p + r, 1e-9)}


def false_boxes(found: list[metrics.Found], truth: list[np.ndarray], threshold: float, cls: int | None = None) -> tuple[int, int]:
    """Detections on pictures without any box, and the number of such pictures."""
    empty = [f for f, t in zip(found, truth) if len(t) == 0]
    return sum(int(((f.score >= threshold) & ((f.cls == cls) | (cls is None))).sum()) for f in empty), len(empty)


def chance(found: list[metrics.Found], pictures: list[data.Picture], truth: list[np.ndarray], rounds: int = 5) -> tuple[float, float]:
    """Fire AP50 when every picture gets the detections of another clip, and with random boxes."""
    rng = np.random.default_rng(0)
    swapped, drawn = [], []
    for _ in range(rounds):
        other = []
        for p in pictures:
            j = int(rng.integers(len(pictures)))
            while pictures[j].clip == p.clip:
                j = int(rng.integers(len(pictures)))
            other.append(found[j])
        swapped.append(metrics.average_precision(*metrics.match(other, truth, 0)))
        noise = []
        for _p in pictures:
            a, b = rng.uniform(0, INPUT, (2, 5, 2))
            boxes = np.concatenate((np.minimum(a, b), np.maximum(a, b)), 1)
            noise.append(metrics.Found(boxes, rng.random(5), np.zeros(5, np.int64)))
        drawn.append(metrics.average_precision(*metrics.match(noise, truth, 0)))
    return float(np.mean(swapped)), float(np.mean(drawn))


def pick(found: list[metrics.Found], truth: list[np.ndarray], cls: int, limit: float) -> float:
    """The threshold with the best F1 among those with at most `limit` false boxes per 100 negatives."""
    best, best_f1 = 0.95, -1.0
    for t in np.arange(0.15, 0.951, 0.01):
        bad, n = false_boxes(found, truth, float(t), cls)
        f1 = at_threshold(found, truth, cls, float(t))["f1"]
        if bad * 100 <= limit * max(n, 1) and f1 > best_f1:
            best, best_f1 = float(t), f1
    return round(best, 2)


def sheet(pictures: list[data.Picture], found: list[metrics.Found], threshold: float, path: Path, most: int = 24) -> None:
    """PNG with truth (green) and detections (red fire, blue smoke; score)."""
    tiles = []
    for i in np.linspace(0, len(pictures) - 1, min(most, len(pictures))).astype(int):
        img, s, dx, dy = data.letterbox(pictures[i].image, INPUT)
        for c, *box in pictures[i].boxes:
            x1, y1, x2, y2 = (np.array(box) * s + (dx, dy, dx, dy)).astype(int).tolist()
            cv2.rectangle(img, (x1, y1), (x2, y2), (0, 255, 0) if c == 0 else (200, 200, 0), 2)
        f = found[i]
        for box, score, c in zip(f.boxes, f.score, f.cls):
            if score < threshold:
                continue
            x1, y1, x2, y2 = (box * s + (dx, dy, dx, dy)).astype(int).tolist()
            colour = (0, 0, 255) if c == 0 else (255, 80, 0)
            cv2.rectangle(img, (x1, y1), (x2, y2), colour, 1)
            cv2.putText(img, f"{score:.2f}", (x1 + 2, y1 + 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
        tiles.append(img)
    while len(tiles) % 6:
        tiles.append(np.full((INPUT, INPUT, 3), data.GREY, np.uint8))
    cv2.imwrite(str(path), np.vstack([np.hstack(tiles[i : i + 6]) for i in range(0, len(tiles), 6)]))


def main() -> None:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--model", type=Path, default=Path("ember-nano.onnx"))
    ap.add_argument("--data", type=Path)
    ap.add_argument("--split", default="test")
    ap.add_argument("--frames", type=Path, action="append", default=[], help="YOLO folders, scored in tiles")
    ap.add_argument("--most", type=int, default=10**6, help="at most this many frames per folder")
    ap.add_argument("--drawn", type=int, default=0)
    ap.add_argument("--pick", action="store_true", help="choose thresholds here (on val, never on test)")
    ap.add_argument("--limit", type=float, default=2.0, help="false boxes per 100 negatives allowed by --pick")
    ap.add_argument("--threshold", type=float, help="instead of the one in the file")
    ap.add_argument("--grey", action="store_true", help="pictures without their palette, as a thermal camera gives them")
    ap.add_argument("--sheet", type=Path, help="write a PNG of detections")
    args = ap.parse_args()
    cv2.setNumThreads(1)
    detector = Detector(args.model)
    print(f"{args.model.name} {detector.meta['version']} sha256 {hashlib.sha256(args.model.read_bytes()).hexdigest()[:16]}...")
    pictures: list[data.Picture] = []
    found: list[metrics.Found] = []
    if args.data:
        sets = data.RGB_SETS if len(detector.names) > 1 else data.THERMAL_SETS
        pictures += data.read_split(args.data, args.split, sets)
    if args.drawn:
        pictures += data.draw(args.drawn, 20_000)
    if args.grey:
        for p in pictures:
            p.image = cv2.cvtColor(cv2.cvtColor(p.image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    found = [detector.fitted(p.image) for p in pictures]
    for folder in args.frames:
        frames = data.read_yolo(folder)
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, min(args.most, len(frames))).astype(int)]
        pictures += frames
        found += [detector.tiled(p.image) for p in frames]
    threshold = args.threshold or float(detector.meta["threshold"])
    truth = [p.boxes for p in pictures]
    labelled = [p.smoke for p in pictures]
    smoke_found = [f for f, ok in zip(found, labelled) if ok]
    smoke_truth = [t for t, ok in zip(truth, labelled) if ok]
    # Where smoke is not labelled, smoke detections are not judged, nor is the picture a smoke negative.
    found = [f if ok else metrics.Found(f.boxes[f.cls == 0], f.score[f.cls == 0], f.cls[f.cls == 0])
             for f, ok in zip(found, labelled)]
    if args.pick:
        threshold = pick(found, truth, 0, args.limit)
        print(f"threshold fire {threshold:.2f}")
        if len(detector.names) > 1:
            print(f"threshold smoke {pick(smoke_found, smoke_truth, 1, args.limit):.2f}")
    print(f"pictures {len(pictures)}, fire boxes {sum(int((t[:, 0] == 0).sum()) for t in truth)}, threshold {threshold:.2f}")
    print(f"fire AP50 {metrics.average_precision(*metrics.match(found, truth, 0)):.3f}")
    scale = [INPUT / max(p.image.shape[:2]) if max(p.image.shape[:2]) <= 2 * INPUT else 1.0 for p in pictures]
    big_truth = [np.c_[t[:, :1], t[:, 1:] * s] for t, s in zip(truth, scale)]
    big_found = [metrics.Found(f.boxes * s, f.score, f.cls) for f, s in zip(found, scale)]
    for name, size in SIZES.items():
        score, hit, total = metrics.match(big_found, big_truth, 0, size=size)
        got = int((hit & (score >= threshold)).sum()) if len(score) else 0
        print(f"  {name} (in the 416 px input): AP50 {metrics.average_precision(score, hit, total):.3f}, "
              f"recall at threshold {got / max(total, 1):.3f} of {total}")
    row = at_threshold(found, truth, 0, threshold)
    print("  at threshold: " + ", ".join(f"{k} {v:.3f}" for k, v in row.items()))
    lit = [(f, t) for f, t in zip(found, truth) if (t[:, 0] == 0).any()]
    seen = sum(bool(at_threshold([f], [t], 0, threshold)["recall"]) for f, t in lit)
    fired = sum(bool(((f.cls == 0) & (f.score >= threshold)).any()) for f, _ in lit)
    print(f"  pictures with fire: {len(lit)}; with a correct box {seen / max(len(lit), 1):.3f}, with any fire box {fired / max(len(lit), 1):.3f}")
    for c, name in enumerate(detector.names):
        bad, n = false_boxes(found, truth, threshold, c)
        print(f"false {name} boxes on {n} negatives: {bad} ({100 * bad / max(n, 1):.1f} per 100)")
    boxes = sum(int((t[:, 0] == 1).sum()) for t in smoke_truth)
    if boxes:
        ap50 = metrics.average_precision(*metrics.match(smoke_found, smoke_truth, 1))
        row = at_threshold(smoke_found, smoke_truth, 1, threshold)
        print(f"smoke AP50 {ap50:.3f} on only {boxes} boxes in {len(smoke_truth)} pictures; "
              + ", ".join(f"{k} {v:.3f}" for k, v in row.items()))
    if args.data:
        square = [np.c_[t[:, :1], t[:, 1:]] for t in big_truth]
        swapped, random = chance(big_found, pictures, square)
        print(f"chance, fire AP50: boxes of another clip {swapped:.3f}, random boxes {random:.3f}")
    if args.sheet:
        sheet(pictures, found, threshold, args.sheet)


if __name__ == "__main__":
    main()
