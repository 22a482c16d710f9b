"""Masks and the closed lines by which YOLO's segment labels tell them, by the rule of odd crossings."""

from __future__ import annotations

import numpy as np


def fill(corners: np.ndarray, h: int, w: int) -> np.ndarray:
    """Pixels [h, w] whose middles the line encloses; corners [n, 2] are x, y in px from the picture's edge."""
    turns = np.zeros((h, w + 1), np.uint8)
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, 0)):
        low, high = (y1, y2) if y1 < y2 else (y2, y1)
        rows = np.arange(max(int(np.ceil(low - 0.5)), 0), min(int(np.ceil(high - 0.5)), h))
        if len(rows):
            x = x1 + (rows + 0.5 - y1) / (y2 - y1) * (x2 - x1)
            turns[rows, np.clip(np.floor(x + 0.5), 0, w).astype(int)] ^= 1
    return np.bitwise_xor.accumulate(turns[:, :w], 1).astype(bool)


def outline(mask: np.ndarray) -> np.ndarray:
    """A line [n, 2] that encloses exactly these pixels: round each run of a row, joined by ways there and back."""
    edge = np.diff(np.pad(mask.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, first = np.nonzero(edge == 1)
    last = np.nonzero(edge == -1)[1]
    rings = np.stack([np.stack(c, -1) for c in
                      ((first, rows), (last, rows), (last, rows + 1), (first, rows + 1), (first, rows))], 1)
    back = rings[1:-1, 0][::-1] if len(rings) > 2 else rings[:0, 0]
    return np.concatenate((rings.reshape(-1, 2), back))


def label(cls: int, mask: np.ndarray) -> str:
    """A line of a label file: the class and the outline as shares of the picture."""
    shares = outline(mask) / (mask.shape[1], mask.shape[0])
    return " ".join([str(cls), *(f"{v:.6f}" for v in shares.ravel())]) + "\n"
