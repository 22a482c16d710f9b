"""Box decoding for scoring, non-maximum suppression and average precision (NumPy)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(slots=True)
class Found:
    """Detections of one picture: boxes [n, 4] px, score [n], class [n], best score first."""

    boxes: np.ndarray
    score: np.ndarray
    cls: np.ndarray


def overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """IoU matrix [n, m] of boxes [n, 4] and [m, 4] (x1, y1, x2, y2)."""
    lt = np.maximum(a[:, None, :2], b[None, :, :2])
    rb = np.minimum(a[:, None, 2:], b[None, :, 2:])
    inter = np.prod(np.clip(rb - lt, 0, None), -1)
    area = np.prod(a[:, 2:] - a[:, :2], -1)[:, None] + np.prod(b[:, 2:] - b[:, :2], -1)[None]
    return inter / np.maximum(area - inter, 1e-9)


def nms(boxes: np.ndarray, score: np.ndarray, limit: float = 0.5) -> np.ndarray:
    """Indices that survive, best score first."""
    order, keep = np.argsort(-score, kind="stable"), []
    while len(order):
        keep.append(order[0])
        order = order[1:][overlap(boxes[order[:1]], boxes[order[1:]])[0] <= limit]
    return np.array(keep, np.int64)


def unpack(scores: np.ndarray, boxes: np.ndarray, floor: float = 0.02, limit: float = 0.5, most: int = 400) -> Found:
    """Scores [cells, nc] and boxes [cells, 4] -> detections after per-class suppression."""
    parts: list[tuple[np.ndarray, np.ndarray, int]] = []
    for c in range(scores.shape[1]):
        at = np.flatnonzero(scores[:, c] > floor)
        at = at[np.argsort(-scores[at, c])][:most]
        at = at[nms(boxes[at], scores[at, c], limit)]
        parts.append((boxes[at], scores[at, c], c))
    found = Found(
        np.concatenate([p[0] for p in parts]),
        np.concatenate([p[1] for p in parts]),
        np.concatenate([np.full(len(p[1]), p[2]) for p in parts]),
    )
    order = np.argsort(-found.score, kind="stable")
    return Found(found.boxes[order], found.score[order], found.cls[order])


def match(found: list[Found], truth: list[np.ndarray], cls: int, iou: float = 0.5,
          size: tuple[float, float] = (0, np.inf)) -> tuple[np.ndarray, np.ndarray, int]:
    """Greedy matching of one class. truth rows are (class, x1, y1, x2, y2).

    Only truth whose side sqrt(w h) lies in `size` px counts; detections on other truth, and
    unmatched detections outside the size range, are left out. Returns score [n], hit [n], truths.
    """
    scores, hits, total = [], [], 0
    for f, t in zip(found, truth):
        t = t[t[:, 0] == cls, 1:]
        side = np.sqrt(np.prod(t[:, 2:] - t[:, :2], -1))
        inside = (side >= size[0]) & (side < size[1])
        total += int(inside.sum())
        at = f.cls == cls
        boxes, score = f.boxes[at], f.score[at]
        table = overlap(boxes, t) if len(t) else np.zeros((len(boxes), 0))
        free = np.ones(len(t), bool)
        for i in range(len(boxes)):
            row = np.where(free, table[i], -1)
            j = int(row.argmax()) if len(t) else -1
            if j >= 0 and row[j] >= iou:
                free[j] = False
                if inside[j]:
                    scores.append(score[i]), hits.append(True)
            else:
                s = np.sqrt(np.prod(boxes[i, 2:] - boxes[i, :2]))
                if size[0] <= s < size[1]:
                    scores.append(score[i]), hits.append(False)
    return np.array(scores), np.array(hits, bool), total


def average_precision(score: np.ndarray, hit: np.ndarray, total: int) -> float:
    """Area under the precision-recall curve with the usual monotone precision envelope."""
    if total == 0:
        return float("nan")
    if len(score) == 0:
        return 0.0
    order = np.argsort(-score, kind="stable")
    tp = np.cumsum(hit[order])
    recall, precision = tp / total, tp / np.arange(1, len(tp) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(np.r_[0, recall]) * precision))
