"""Target assignment (adaptive, by centre distance and anchor overlap) and the three losses."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from .model import BINS, decode

NEAREST = 9  # candidates per box and level
ANCHOR = 5.0  # side of the imagined anchor, unit: stride
WEIGHTS = {"qfl": 1.0, "dfl": 0.25, "giou": 2.0}


def iou(a: Tensor, b: Tensor, generalised: bool = False) -> Tensor:
    """Overlap of boxes [..., 4] (px), element by element with broadcasting: IoU 0..1 or GIoU -1..1."""
    lt, rb = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    inter = (rb - lt).clamp(min=0).prod(-1)
    area = (a[..., 2:] - a[..., :2]).prod(-1) + (b[..., 2:] - b[..., :2]).prod(-1) - inter
    value = inter / area.clamp(min=1e-6)
    if not generalised:
        return value
    hull = (torch.maximum(a[..., 2:], b[..., 2:]) - torch.minimum(a[..., :2], b[..., :2])).prod(-1)
    return value - (hull - area) / hull.clamp(min=1e-6)


def assign(boxes: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    """For one picture, boxes [n, 4] px -> index of the box each cell answers for [cells], -1 = none."""
    count = len(boxes)
    owner = torch.full((len(centres),), -1, dtype=torch.long)
    if count == 0:
        return owner
    half = (strides * ANCHOR / 2)[:, None]
    overlap = iou(torch.cat((centres - half, centres + half), 1)[None], boxes[:, None])  # [n, cells]
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    gap = torch.cdist(middle, centres)
    picks = []
    for s in strides.unique():
        level = (strides == s).nonzero()[:, 0]
        picks.append(level[gap[:, level].topk(min(NEAREST, len(level)), largest=False).indices])
    pick = torch.cat(picks, 1)  # [n, candidates]
    score = overlap.gather(1, pick)
    good = score >= (score.mean(1) + score.std(1))[:, None]
    at = centres[pick]
    reach = torch.stack((at - boxes[:, None, :2], boxes[:, None, 2:] - at)).amin((0, 3))
    good &= reach > 0.01
    # A tiny box may hold no cell centre at all: its nearest fine cell answers.
    none = ~good.any(1)
    good[none, 0] = True
    area = (boxes[:, 2:] - boxes[:, :2]).prod(1)
    for i in area.argsort(descending=True).tolist():  # small boxes win shared cells
        owner[pick[i][good[i]]] = i
    return owner


@torch.no_grad()
def owners(boxes: Tensor, grid: tuple[Tensor, Tensor]) -> Tensor:
    """Boxes [B, M, 5] px -> index of the box each cell answers for [B, cells], -1 = none."""
    return torch.stack([assign(b[b[:, 0] >= 0, 1:], *grid) for b in boxes])


def losses(
    out: Tensor, boxes: Tensor, valid: Tensor, nc: int, grid: tuple[Tensor, Tensor], owner: Tensor
) -> dict[str, Tensor]:
    """out [B, cells, nc + 32] with score logits, boxes [B, M, 5] px, valid [B, H/8, W/8] bit map, the
    network's cells (centres and strides), and the box of each."""
    centres, strides = grid
    judge = []
    for s in strides.unique():
        k = int(s) // 8
        judge.append(valid[:, ::k, ::k].flatten(1))
    bits = torch.cat(judge, 1)
    weight = torch.stack([(bits >> c) & 1 for c in range(nc)], -1).to(out.dtype)
    b_at, c_at = (owner >= 0).nonzero(as_tuple=True)
    logits, target = out[..., :nc], torch.zeros_like(out[..., :nc])
    zero = out.sum() * 0
    giou = dfl = zero
    total = torch.tensor(1.0)
    if len(b_at):
        want = boxes[b_at, owner[b_at, c_at]]
        dist = out[b_at, c_at, nc:]
        centre, stride = centres[c_at], strides[c_at]
        box = decode(dist, centre, stride)
        quality = iou(box.detach(), want[:, 1:]).clamp(0, 1)
        cls = want[:, 0].long()
        target[b_at, c_at, cls] = quality
        weight[b_at, c_at, cls] = 1.0
        trust = logits.detach()[b_at, c_at].sigmoid().amax(1).clamp(min=0.05)
        total = trust.sum().clamp(min=1.0)
        giou = ((1 - iou(box, want[:, 1:], True)) * trust).sum() / total
        side = torch.cat((centre - want[:, 1:3], want[:, 3:] - centre), 1) / stride[:, None]
        side = side.clamp(0, BINS - 1 - 0.01)
        left = side.long()
        logp = dist.unflatten(-1, (4, BINS)).log_softmax(-1)
        frac = (side - left)[..., None]
        part = logp.gather(-1, left[..., None]) * (1 - frac) + logp.gather(-1, left[..., None] + 1) * frac
        dfl = -(part[..., 0].mean(1) * trust).sum() / total
    gap = (target - logits.sigmoid()).abs().pow(2)
    qfl = (F.binary_cross_entropy_with_logits(logits, target, reduction="none") * gap * weight).sum()
    qfl = qfl / max(len(b_at), 1)
    parts = {"qfl": qfl, "dfl": dfl, "giou": giou}
    return parts | {"total": sum(WEIGHTS[k] * v for k, v in parts.items())}
