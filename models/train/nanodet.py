"""NanoDet-m, the public architecture that ember-nano is put beside: ShuffleNetV2 1.0x (Ma et al. 2018),
a path-aggregation neck without convolutions of its own, and one head of two separable convolutions per level
(facts: the paper, and the figures in NanoDet's read-me; the code is ours).

Input as ember-nano's. Outputs, per stride 8, 16, 32: scores [cells, nc] (sigmoid) and sides [cells, 32];
the centre of a cell is (index + 1/2) * stride.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from .model import BINS

CHANNELS = (24, 116, 232, 464)  # behind the stem and the three stages
UNITS = (4, 8, 4)
NECK = 96


def conv(cin: int, cout: int, k: int = 1, s: int = 1, groups: int = 1, act: bool = True) -> nn.Sequential:
    """Convolution, batch norm and (by default) a leaky ReLU."""
    layers: list[nn.Module] = [nn.Conv2d(cin, cout, k, s, k // 2, groups=groups, bias=False), nn.BatchNorm2d(cout)]
    return nn.Sequential(*layers, *([nn.LeakyReLU(0.1, inplace=True)] if act else []))


class Unit(nn.Module):
    """Half of the channels pass, the others are convolved, then all are shuffled; at stride 2 both halves
    are convolved."""

    def __init__(self, cin: int, cout: int, s: int) -> None:
        super().__init__()
        half = cout // 2
        self.near = nn.Sequential(conv(cin, cin, 3, 2, cin, act=False), conv(cin, half)) if s == 2 else None
        start = cin if s == 2 else half
        self.far = nn.Sequential(conv(start, half), conv(half, half, 3, s, half, act=False), conv(half, half))

    def forward(self, x: Tensor) -> Tensor:
        a, b = x.chunk(2, 1) if self.near is None else (self.near(x), x)
        y = torch.cat((a, self.far(b)), 1)
        return y.unflatten(1, (2, y.shape[1] // 2)).transpose(1, 2).flatten(1, 2)


class Shuffle(nn.Module):
    """[B, 3, H, W] -> maps at strides 8, 16 and 32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv(3, CHANNELS[0], 3, 2), nn.MaxPool2d(3, 2, 1))
        self.stages = nn.ModuleList(
            nn.Sequential(Unit(cin, cout, 2), *(Unit(cout, cout, 1) for _ in range(count - 1)))
            for cin, cout, count in zip(CHANNELS, CHANNELS[1:], UNITS)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        maps = [self.stem(x)]
        for stage in self.stages:
            maps.append(stage(maps[-1]))
        return maps[1:]


class Head(nn.Module):
    """Scores and sides of one level from the same two separable convolutions."""

    def __init__(self, nc: int) -> None:
        super().__init__()
        self.body = nn.Sequential(*(nn.Sequential(conv(NECK, NECK, 3, groups=NECK), conv(NECK, NECK)) for _ in range(2)))
        self.out = nn.Conv2d(NECK, nc + 4 * BINS, 1)
        nn.init.normal_(self.out.weight, std=0.01)
        nn.init.zeros_(self.out.bias)
        nn.init.constant_(self.out.bias[:nc], -4.6)  # sigmoid = 0.01 at the start

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.body(x))


class NanoDetM(nn.Module):
    """Trunk, neck and heads; `logits` is what the losses take, `forward` the six maps of the contract."""

    family = "nanodet"
    strides = (8, 16, 32)
    within = 0.5  # of a stride from a cell's corner to where it stands

    def __init__(self, nc: int = 2) -> None:
        super().__init__()
        self.trunk = Shuffle()
        self.lateral = nn.ModuleList(nn.Conv2d(c, NECK, 1) for c in CHANNELS[1:])
        self.heads = nn.ModuleList(Head(nc) for _ in self.strides)
        self.nc = nc

    def levels(self, x: Tensor) -> list[Tensor]:
        """Raw maps per stride: [B, nc + 32, h, w] with scores still as logits."""
        p8, p16, p32 = (m(c) for m, c in zip(self.lateral, self.trunk(x)))
        p16 = p16 + interpolate(p32, scale_factor=2.0, mode="bilinear")
        p8 = p8 + interpolate(p16, scale_factor=2.0, mode="bilinear")
        p16 = p16 + interpolate(p8, scale_factor=0.5, mode="bilinear")
        p32 = p32 + interpolate(p16, scale_factor=0.5, mode="bilinear")
        return [h(p) for h, p in zip(self.heads, (p8, p16, p32))]

    def logits(self, x: Tensor) -> Tensor:
        """[B, cells, nc + 32], scores as logits, cells row-major in stride order."""
        return torch.cat([m.flatten(2) for m in self.levels(x)], 2).transpose(1, 2)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        rows = [m.flatten(2).transpose(1, 2) for m in self.levels(x)]
        return tuple(r[..., : self.nc].sigmoid() for r in rows) + tuple(r[..., self.nc :] for r in rows)
