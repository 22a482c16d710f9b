"""EmberNano: a small one-stage detector that speaks the NanoDet-Plus tensor contract.

Input  [B, 3, H, W] float32, BGR, normalised with MEAN and STD (pixel values 0..255).
Output [B, cells, nc + 32]: nc class scores (sigmoid) and 4 sides x 8 bins of distance
logits (left, top, right, bottom; unit: stride). The centre of a cell is index * stride.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .trunk import MEAN, STD, Trunk, conv

NAMES = ("fire", "smoke")
STRIDES = (8, 16, 32, 64)
BINS = 8  # distance = stride * sum(softmax(logits) * 0..7)
INPUT = 416  # px, side of the square input

__all__ = ["BINS", "INPUT", "MEAN", "NAMES", "STD", "STRIDES", "EmberNano", "cells", "decode"]


def separable(cin: int, cout: int, k: int = 3, s: int = 1) -> nn.Sequential:
    """Depthwise k x k followed by pointwise 1 x 1."""
    return nn.Sequential(conv(cin, cin, k, s, groups=cin, act=False), conv(cin, cout))


class Head(nn.Module):
    """Score and distance prediction of one level: [B, C, h, w] -> scores nc, distances 32."""

    def __init__(self, c: int, nc: int) -> None:
        super().__init__()
        self.cls = nn.Sequential(separable(c, c), nn.Conv2d(c, nc, 1))
        self.reg = nn.Sequential(separable(c, c), nn.Conv2d(c, 4 * BINS, 1))
        nn.init.normal_(self.cls[1].weight, std=0.01)
        nn.init.constant_(self.cls[1].bias, -4.6)  # sigmoid = 0.01 at the start

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat((self.cls(x), self.reg(x)), 1)


class EmberNano(nn.Module):
    """Trunk (strides 2..32), path-aggregation neck with one extra level (64), a head per level."""

    family = "nanodet-plus"
    strides = STRIDES
    within = 0.0  # of a stride from a cell's corner to where it stands

    def __init__(self, nc: int = len(NAMES), neck: int = 72) -> None:
        super().__init__()
        self.trunk = Trunk()
        self.lateral = nn.ModuleList(conv(c, neck) for c in self.trunk.channels)
        self.up = nn.ModuleList(separable(2 * neck, neck, 5) for _ in range(2))
        self.down = nn.ModuleList(separable(neck, neck, 5, 2) for _ in range(2))
        self.fuse = nn.ModuleList(separable(2 * neck, neck, 5) for _ in range(2))
        self.extra = separable(neck, neck, 5, 2)
        self.heads = nn.ModuleList(Head(neck, nc) for _ in STRIDES)
        self.nc = nc

    def levels(self, x: Tensor) -> list[Tensor]:
        """Raw maps per stride: [B, nc + 32, h, w] with scores still as logits."""
        p8, p16, p32 = (m(c) for m, c in zip(self.lateral, self.trunk(x)))
        t16 = self.up[0](torch.cat((p16, nn.functional.interpolate(p32, scale_factor=2.0)), 1))
        o8 = self.up[1](torch.cat((p8, nn.functional.interpolate(t16, scale_factor=2.0)), 1))
        o16 = self.fuse[0](torch.cat((t16, self.down[0](o8)), 1))
        o32 = self.fuse[1](torch.cat((p32, self.down[1](o16)), 1))
        return [h(o) for h, o in zip(self.heads, (o8, o16, o32, self.extra(o32)))]

    def logits(self, x: Tensor) -> Tensor:
        """[B, cells, nc + 32], scores as logits, cells row-major in stride order."""
        return torch.cat([m.flatten(2) for m in self.levels(x)], 2).transpose(1, 2)

    def forward(self, x: Tensor) -> Tensor:
        out = self.logits(x)
        return torch.cat((out[..., : self.nc].sigmoid(), out[..., self.nc :]), 2)


def cells(height: int, width: int, levels: tuple[int, ...] = STRIDES, within: float = 0.0) -> tuple[Tensor, Tensor]:
    """Cell centres [cells, 2] (x, y in px) and strides [cells] of an input of that size; `levels` start at 8
    and double."""
    centres, strides = [], []
    h, w = height // 8, width // 8
    for s in levels:
        y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        centres.append(torch.stack((x, y), -1).reshape(-1, 2).add(within) * float(s))
        strides.append(torch.full((h * w,), float(s)))
        h, w = (h + 1) // 2, (w + 1) // 2
    return torch.cat(centres), torch.cat(strides)


def decode(distances: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    """Distance logits [..., cells, 32] -> boxes [..., cells, 4] (x1, y1, x2, y2 in input px)."""
    bins = torch.arange(BINS, dtype=distances.dtype)
    side = (distances.unflatten(-1, (4, BINS)).softmax(-1) @ bins) * strides[:, None]
    return torch.cat((centres - side[..., :2], centres + side[..., 2:]), -1)
