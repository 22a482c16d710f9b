"""ember-look: a second look at what a detector has boxed. Does it burn, or does it only look like it?

    python -m train.second_look --data DATA --detector ember-nano.onnx --out OUT --extra SIM

Samples are a detector's boxes at a low threshold, and the true boxes, jittered, each cut out with a margin and brought
to 48 px: what burns is what overlaps with something labelled, as the evaluation of events has it.

Input  [N, 3, 48, 48] float32, BGR, normalised as the detector's.
Output [N, 2]: log-odds that it is flame, that it is smoke; which of them counts is the detector's to say.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import torch
from numpy.random import Generator
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm

from . import data
from .evaluate import Detector
from .export import TRUNK_CREDIT, VISIBLE_CREDIT
from .model import MEAN, NAMES, STD
from .trunk import Trunk

SIDE = 48  # px, side of the network's input
MARGIN = 1.6  # side of what is cut out, in the box's longer side
LOW = 0.15  # score from which a box is a sample
OVERLAP, PART = 0.2, 0.6  # of a box with something that burns: IoU, or share of the smaller one's area


class EmberLook(nn.Module):
    """The first five stages of a detector's trunk, as they are; means and largest values of what they see at strides 8 and
    16; two layers that judge those."""

    seen = {2: 40, 4: 112}  # stage: channels

    def __init__(self, hidden: int = 64, dropout: float = 0.3) -> None:
        super().__init__()
        self.trunk = Trunk()
        wide = 2 * sum(self.seen.values())
        self.middle, self.spread = (nn.Parameter(x, requires_grad=False) for x in (torch.zeros(wide), torch.ones(wide)))
        self.judge = nn.Sequential(
            nn.Dropout(dropout), nn.Linear(wide, hidden), nn.ReLU(), nn.Dropout(dropout), nn.Linear(hidden, len(NAMES))
        )

    def features(self, x: Tensor) -> Tensor:
        """[N, 3, SIDE, SIDE] -> [N, 304]."""
        x, parts = self.trunk.stem(x), []
        for i, stage in enumerate(self.trunk.stages[: max(self.seen) + 1]):
            x = stage(x)
            if i in self.seen:
                parts += [x.mean((2, 3)), x.amax((2, 3))]
        return torch.cat(parts, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.judge((self.features(x) - self.middle) / self.spread)


def shared(box: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """IoU of a box [4] with others [n, 4], and the overlap as a share of the smaller one of each two."""
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    both = np.prod(np.clip(high - low, 0, None), 1)
    areas = np.prod(others[:, 2:] - others[:, :2], 1), np.prod(box[2:] - box[:2])
    return both / (areas[0] + areas[1] - both), both / np.minimum(areas[0], areas[1])


def burns(cls: int, box: np.ndarray, truth: np.ndarray) -> bool:
    """Whether a detector's box shows something that burns: about all of it, or a part of its kind."""
    iou, part = shared(box, truth[:, 1:])
    return bool(((iou >= OVERLAP) | ((truth[:, 0] == cls) & (part >= PART))).any())


def cut(image: np.ndarray, box: np.ndarray) -> np.ndarray:
    """What the network looks at: a square about the box, edges repeated, [SIDE, SIDE, 3]."""
    side = max(8, int(np.ceil(MARGIN * max(box[2] - box[0], box[3] - box[1]))))
    middle = (float(box[0] + box[2]) / 2, float(box[1] + box[3]) / 2)
    return cv2.resize(cv2.getRectSubPix(image, (side, side), middle), (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def jitter(box: np.ndarray, rng: Generator) -> np.ndarray:
    """The same box as another look might have it."""
    middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2
    middle = middle + rng.normal(0, 0.1, 2) * half * 2
    half = half * np.exp(rng.normal(0, 0.15, 2))
    return np.r_[middle - half, middle + half]


def samples(pictures: list[data.Picture], detector: Detector, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Cuts [n, SIDE, SIDE, 3] and rows (class, burns, real) of all boxes that may be judged."""
    rng = np.random.default_rng(seed)
    cuts, rows = [], []
    for p in tqdm(pictures, desc="boxes", mininterval=5):
        found = detector.fitted(p.image)
        keep = found.score >= LOW
        boxes = [(int(c), b) for c, b in zip(found.cls[keep], found.boxes[keep])]
        boxes += [(int(row[0]), jitter(row[1:], rng)) for row in p.boxes for _ in range(2)]
        for cls, box in boxes:
            if (cls == 1 and not p.smoke) or min(box[2:] - box[:2]) < 4:
                continue
            cuts.append(cut(p.image, box))
            rows.append((cls, burns(cls, box, p.boxes), p.name.split("/")[0] in data.RGB_SETS))
    return np.array(cuts), np.array(rows, np.int64).reshape(-1, 3)


def altered(images: np.ndarray, rng: Generator) -> np.ndarray:
    """Mirrored, brighter or darker, of another white balance, noisier, blurred, shifted a little."""
    out = images.astype(np.float32)
    n = len(out)
    flip = rng.random(n) < 0.5
    out[flip] = out[flip, :, ::-1]
    out = out * np.exp(rng.normal(0, 0.15, (n, 1, 1, 1))) * np.exp(rng.normal(0, 0.05, (n, 1, 1, 3)))
    out = out + rng.normal(0, 8, (n, 1, 1, 1))
    for i in np.flatnonzero(rng.random(n) < 0.6):
        scale, (dx, dy) = np.exp(rng.normal(0, 0.1)), rng.normal(0, 2, 2)
        m = np.array([[scale, 0, (1 - scale) * SIDE / 2 + dx], [0, scale, (1 - scale) * SIDE / 2 + dy]], np.float32)
        out[i] = cv2.warpAffine(out[i], m, (SIDE, SIDE), borderMode=cv2.BORDER_REPLICATE)
    for i in np.flatnonzero(rng.random(n) < 0.3):
        out[i] = cv2.GaussianBlur(out[i], (0, 0), rng.uniform(0.4, 1.4))
    return np.clip(out + rng.normal(0, rng.uniform(0, 6), out.shape), 0, 255).astype(np.float32)


def tensor(images: np.ndarray) -> Tensor:
    """[n, h, w, 3] pixels -> what the network takes."""
    x = (images.astype(np.float32) - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
    return torch.from_numpy(np.ascontiguousarray(x.transpose(0, 3, 1, 2)))


def batches(rows: np.ndarray, size: int, rng: Generator) -> Iterator[np.ndarray]:
    """Indices without end: each class, each answer and each origin as often as any other that there is."""
    kinds = [np.flatnonzero((rows == kind).all(1)) for kind in np.unique(rows, axis=0)]
    while True:
        yield np.array([rng.choice(kinds[k]) for k in rng.integers(0, len(kinds), size)])


def ranked(score: np.ndarray, truth: np.ndarray) -> float:
    """Area under the curve: how often a true one stands above a false one."""
    order = np.empty(len(score))
    order[np.argsort(score)] = np.arange(len(score))
    true, false = order[truth == 1], (truth == 0).sum()
    return float((true.sum() - len(true) * (len(true) - 1) / 2) / max(len(true) * false, 1))


def features(model: EmberLook, cuts: np.ndarray) -> np.ndarray:
    """What the trunk sees in each cut, [n, 304]."""
    model.eval()
    with torch.no_grad():
        parts = [model.features(tensor(part)) for part in tqdm(np.array_split(cuts, max(1, len(cuts) // 128)), mininterval=5)]
    return torch.cat(parts).numpy()


def told(name: str, model: EmberLook, seen: np.ndarray, rows: np.ndarray) -> str:
    """How well it tells what burns from what does not, by class."""
    with torch.no_grad():
        out = model.eval().judge((torch.from_numpy(seen) - model.middle) / model.spread).numpy()
    score, parts = out[np.arange(len(rows)), rows[:, 0]], []
    for cls, kind in enumerate(NAMES):
        here = rows[:, 0] == cls
        n = [int((rows[here, 1] == answer).sum()) for answer in (1, 0)]
        if min(n) > 0:
            parts.append(f"{kind} {ranked(score[here], rows[here, 1]):.3f} of {n[0]} that burn, {n[1]} that do not")
    return f"{name}: area under the curve " + "; ".join(parts)


def train(model: EmberLook, seen: np.ndarray, rows: np.ndarray, args: argparse.Namespace) -> None:
    """AdamW on the two layers, cosine schedule; `seen` [versions, n, 304] of the cuts, plain and altered."""
    rng = np.random.default_rng(args.seed)
    with torch.no_grad():
        model.middle.copy_(torch.from_numpy(seen[0].mean(0)))
        model.spread.copy_(torch.from_numpy(seen[0].std(0) + 1e-3))
    looks, truth = torch.from_numpy(seen), torch.from_numpy(rows)
    optimiser = torch.optim.AdamW(model.judge.parameters(), lr=args.lr, weight_decay=0.05)
    model.judge.train()
    for step, index in zip(tqdm(range(args.steps), mininterval=5), batches(rows, args.batch, rng)):
        for group in optimiser.param_groups:
            group["lr"] = args.lr * 0.5 * (1 + np.cos(np.pi * step / args.steps))
        x = looks[torch.from_numpy(rng.integers(0, len(seen), len(index))), torch.from_numpy(index)]
        out = model.judge((x - model.middle) / model.spread)[torch.arange(len(index)), truth[index, 0]]
        # Labels err.
        loss = F.binary_cross_entropy_with_logits(out, truth[index, 1].float() * 0.94 + 0.03)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def export(model: nn.Module, path: Path, seed: int) -> None:
    """Write the file, and hold it against PyTorch."""
    sample = torch.randn(3, 3, SIDE, SIDE)
    names = {"input_names": ["looks"], "output_names": ["log_odds"]}
    axes = {name: {0: "looks"} for name in ("looks", "log_odds")}
    torch.onnx.export(model, (sample,), str(path), opset_version=17, dynamic_axes=axes, dynamo=False, **names)
    proto = onnx.load(str(path))
    meta = {
        "family": "ember-look", "names": json.dumps(dict(enumerate(NAMES))), "input_size": str(SIDE), "margin": str(MARGIN),
        "color": "bgr", "mean": json.dumps(MEAN), "std": json.dumps(STD), "version": "0.1.0", "seed": str(seed),
        "credit": VISIBLE_CREDIT + TRUNK_CREDIT,
    }
    onnx.helper.set_model_props(proto, meta)
    proto.producer_name, proto.producer_version = "emberfix-train", "0.1.0"
    onnx.checker.check_model(proto)
    onnx.save(proto, str(path))
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    with torch.no_grad():
        worst = np.abs(session.run(None, {"looks": sample.numpy()})[0] - model(sample).numpy()).max()
    print(f"{path}: {path.stat().st_size} bytes, {used(model)} parameters, "
          f"largest difference {worst:.1e}, sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}")


def used(model: EmberLook) -> int:
    """Parameters that the file holds."""
    left_out = list(model.trunk.stages[max(model.seen) + 1 :].parameters())
    return sum(p.numel() for p in model.parameters()) - sum(p.numel() for p in left_out)


def main() -> None:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--data", type=Path, required=True, help="folder with manifest.csv and splits/")
    ap.add_argument("--detector", type=Path, default=Path("ember-nano.onnx"), help="whose boxes are looked at")
    ap.add_argument("--extra", type=Path, action="append", default=[], help="YOLO folders, e.g. simulated frames")
    ap.add_argument("--drawn", type=int, default=600, help="procedural pictures")
    ap.add_argument("--out", type=Path, required=True, help="outside the project: samples that are kept, the file")
    ap.add_argument("--steps", type=int, default=1500)
    ap.add_argument("--batch", type=int, default=256)
    ap.add_argument("--lr", type=float, default=3e-3)
    ap.add_argument("--seed", type=int, default=1)
    args = ap.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    detector = Detector(args.detector)
    kept = args.out / "samples.npz"
    if not kept.exists():
        extra = [p for d in args.extra for p in data.read_yolo(d)]
        apart, extra = extra[::10], [p for i, p in enumerate(extra) if i % 10]
        drawn = data.draw(args.drawn, args.seed, args.out / f"drawn-{args.seed}-{args.drawn}.npz")
        sets = data.read_split(args.data, "train") + drawn + extra, data.read_split(args.data, "val"), apart
        np.savez(kept, *(part for pictures in sets for part in samples(pictures, detector, args.seed)))
    with np.load(kept) as parts:
        cuts, rows, val_cuts, val_rows, sim_cuts, sim_rows = (parts[f"arr_{i}"] for i in range(6))
    for row, n in zip(*np.unique(rows, axis=0, return_counts=True)):
        print(f"{NAMES[row[0]]}, {'burns' if row[1] else 'does not burn'}, {'real' if row[2] else 'made'}: {n}")
    torch.manual_seed(args.seed)
    model, rng = EmberLook(), np.random.default_rng(args.seed)
    some = rng.choice(len(cuts), min(256, len(cuts)), replace=False)
    model.trunk.start_from_onnx(args.detector, tensor(cuts[some]))
    seen = args.out / "features.npz"
    if not seen.exists():
        versions = np.stack([features(model, part) for part in (cuts, altered(cuts, rng), altered(cuts, rng))])
        np.savez(seen, versions, features(model, val_cuts), features(model, sim_cuts))
    with np.load(seen) as parts:
        versions, val_seen, sim_seen = (parts[f"arr_{i}"] for i in range(3))
    train(model, versions, rows, args)
    print(told("real, val", model, val_seen, val_rows))
    print(told("simulated, apart", model, sim_seen, sim_rows))
    export(model, args.out / "ember-look.onnx", args.seed)


if __name__ == "__main__":
    main()
