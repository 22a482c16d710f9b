"""EmberSeg: boxes and instance masks of fire and smoke, in the tensors of the family `yolov8-seg`.

The two ideas of YOLO-EB (Ni et al.), each of which can be left out: efficient channel attention (Wang et
al. 2020) on what the trunk hands over, and a bidirectional weighted pyramid (Tan et al. 2020) as the neck.

Input  [B, 3, H, W] float32, BGR, normalised with MEAN and STD, H and W multiples of 32.
Output `output0` [B, 4 + nc + 32, cells]: middle x, middle y, width, height in input px, nc scores (sigmoid),
32 mask coefficients; `output1` [B, 32, H/4, W/4]: prototypes. A mask is where the sum of the prototypes,
weighted by a box's coefficients and interpolated, is above zero; pixel i of a prototype stands at 4 (i + 1/2).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .model import BINS, NAMES, cells, decode, separable
from .trunk import STAGES, Trunk, conv

PROTOTYPES = 32
NECK = 72
GRID = 28  # points along a side of a box at which its mask is compared
MOST = 128  # boxes of a batch whose masks are compared


def resized(x: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(x, size=like.shape[-2:], mode="nearest")


class ChannelAttention(nn.Module):
    """Each channel is weighed by its mean and its neighbours' means; the reach grows with log2(channels)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        reach = int((math.log2(channels) + 1) / 2)
        reach += 1 - reach % 2
        self.mix = nn.Conv1d(1, 1, reach, padding=reach // 2, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        means = x.mean((2, 3))[:, None]
        return x * self.mix(means).sigmoid()[:, 0, :, None, None]


class Fusion(nn.Module):
    """A mean of maps by learned weights that are never negative and sum to one, then a convolution."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(count))
        self.body = separable(NECK, NECK, 5)

    def shares(self) -> Tensor:
        weight = self.weight.relu()
        return weight / (weight.sum() + 1e-4)

    def forward(self, *maps: Tensor) -> Tensor:
        return self.body(sum(s * m for s, m in zip(self.shares(), maps)))


class TwoWays(nn.Module):
    """One pass of the weighted pyramid over maps, finest first: down from the coarsest, and up again to the
    `kept` finest; on the way up a middle map is fused with what came in, too."""

    def __init__(self, levels: int, kept: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(Fusion(2) for _ in range(levels - 1))
        self.up = nn.ModuleList(Fusion(3 if i < levels - 1 else 2) for i in range(1, kept))

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        mid = list(maps)
        for i in reversed(range(len(maps) - 1)):
            mid[i] = self.down[i](maps[i], resized(mid[i + 1], maps[i]))
        out = mid[:1]
        for i, fuse in enumerate(self.up, 1):
            finer = F.max_pool2d(out[-1], 3, 2, 1)
            between = (mid[i],) if i < len(maps) - 1 else ()
            out.append(fuse(maps[i], *between, finer))
        return out


class Weighted(nn.Module):
    """Two passes over strides 8 to 64; the coarsest is context alone, without a head."""

    def __init__(self) -> None:
        super().__init__()
        self.passes = nn.ModuleList((TwoWays(4, 4), TwoWays(4, 3)))

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        maps = [*maps, F.max_pool2d(maps[-1], 3, 2, 1)]
        for once in self.passes:
            maps = once(maps)
        return maps


class Aggregation(nn.Module):
    """What the weighted pyramid is compared with: path aggregation by concatenation, as in ember-nano."""

    def __init__(self) -> None:
        super().__init__()
        self.up = nn.ModuleList(separable(2 * NECK, NECK, 5) for _ in range(2))
        self.down = nn.ModuleList(separable(NECK, NECK, 5, 2) for _ in range(2))
        self.fuse = nn.ModuleList(separable(2 * NECK, NECK, 5) for _ in range(2))

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        p8, p16, p32 = maps
        t16 = self.up[0](torch.cat((p16, resized(p32, p16)), 1))
        o8 = self.up[1](torch.cat((p8, resized(t16, p8)), 1))
        o16 = self.fuse[0](torch.cat((t16, self.down[0](o8)), 1))
        return [o8, o16, self.fuse[1](torch.cat((p32, self.down[1](o16)), 1))]


class Head(nn.Module):
    """Scores, distances and mask coefficients of one level: [B, C, h, w] -> [B, nc + 32 + 32, h, w]."""

    def __init__(self, nc: int) -> None:
        super().__init__()
        self.cls = nn.Sequential(separable(NECK, NECK), nn.Conv2d(NECK, nc, 1))
        self.reg = nn.Sequential(separable(NECK, NECK), nn.Conv2d(NECK, 4 * BINS, 1))
        self.mask = nn.Sequential(separable(NECK, NECK), nn.Conv2d(NECK, PROTOTYPES, 1))
        nn.init.normal_(self.cls[1].weight, std=0.01)
        nn.init.constant_(self.cls[1].bias, -4.6)  # sigmoid = 0.01 at the start

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat((self.cls(x), self.reg(x), self.mask(x)), 1)


class EmberSeg(nn.Module):
    """Trunk, attention, neck, a head per level, and prototypes from the finest map and the trunk's at
    stride 4."""

    family = "yolov8-seg"
    strides = (8, 16, 32)
    within = 0.0  # of a stride from a cell's corner to where it stands

    def __init__(self, nc: int = len(NAMES), attention: bool = True, weighted: bool = True) -> None:
        super().__init__()
        self.trunk = Trunk()
        channels = self.trunk.channels
        self.attention = nn.ModuleList(ChannelAttention(c) if attention else nn.Identity() for c in channels)
        self.lateral = nn.ModuleList(conv(c, NECK) for c in channels)
        self.neck = Weighted() if weighted else Aggregation()
        self.heads = nn.ModuleList(Head(nc) for _ in self.strides)
        self.fine = conv(STAGES[1][-1][1], NECK)
        self.prototypes = nn.Sequential(separable(NECK, NECK), separable(NECK, NECK), nn.Conv2d(NECK, PROTOTYPES, 1))
        self.nc = nc

    def parts(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """[B, cells, nc + 32] with scores as logits, coefficients [B, cells, 32], prototypes [B, 32, H/4, W/4]."""
        fine, *maps = self.trunk.all(x)
        maps = [lateral(attend(m)) for lateral, attend, m in zip(self.lateral, self.attention, maps)]
        maps = self.neck(maps)
        rows = torch.cat([h(m).flatten(2) for h, m in zip(self.heads, maps)], 2).transpose(1, 2)
        prototypes = self.prototypes(self.fine(fine) + resized(maps[0], fine))
        return rows[..., : self.nc + 4 * BINS], rows[..., self.nc + 4 * BINS :], prototypes

    def logits(self, x: Tensor) -> Tensor:
        """Scores and distances alone."""
        return self.parts(x)[0]

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        out, coefficients, prototypes = self.parts(x)
        boxes = decode(out[..., self.nc :], *cells(x.shape[2], x.shape[3], self.strides, self.within))
        low, high = boxes[..., :2], boxes[..., 2:]
        rows = torch.cat(((low + high) / 2, high - low, out[..., : self.nc].sigmoid(), coefficients), 2)
        return rows.transpose(1, 2), prototypes


def mask_loss(
    coefficients: Tensor, prototypes: Tensor, boxes: Tensor, ids: Tensor, owner: Tensor, side: int
) -> Tensor:
    """How far masks are from the truth, at GRID x GRID points in and closely around the true box: cross
    entropy and what is missing of the overlap. `owner` [B, cells] is the box of each cell, -1 = none; the
    pixels of box k of a picture have k + 1 in `ids` [B, side, side]. Boxes whose pixels aren't known are
    left out."""
    there = torch.zeros(len(ids), 256, dtype=torch.bool)
    for b, of in enumerate(ids):
        there[b, of.unique().long()] = True
    b_at, c_at = (owner >= 0).nonzero(as_tuple=True)
    known = there[b_at, (owner[b_at, c_at] + 1).clamp(max=255)]
    b_at, c_at = b_at[known], c_at[known]
    if len(b_at) == 0:
        return prototypes.sum() * 0
    pick = torch.randperm(len(b_at))[:MOST].sort().values
    b_at, c_at = b_at[pick], c_at[pick]
    own = owner[b_at, c_at]
    sums = []
    for b in b_at.unique():
        sums.append(coefficients[b, c_at[b_at == b]] @ prototypes[b].flatten(1))
    logits = torch.cat(sums).unflatten(1, prototypes.shape[2:])[:, None]
    box = boxes[b_at, own, 1:]
    half = (box[:, 2:] - box[:, :2]) / 2
    half = torch.maximum(half * 1.1, half + 2)
    line = (torch.arange(GRID) + 0.5) / GRID * 2 - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    points = ((box[:, :2] + box[:, 2:]) / 2)[:, None, None] + half[:, None, None] * torch.stack((x, y), -1)
    seen = F.grid_sample(logits, points / side * 2 - 1, padding_mode="border", align_corners=False)[:, 0]
    at = points.floor().long().clamp(0, side - 1)
    truth = (ids[b_at[:, None, None], at[..., 1], at[..., 0]] == (own + 1)[:, None, None]).float()
    cross = F.binary_cross_entropy_with_logits(seen, truth)
    chance = seen.sigmoid()
    both, either = (chance * truth).sum((1, 2)), (chance * chance + truth).sum((1, 2))
    return cross + (1 - (2 * both + 1) / (either + 1)).mean()
