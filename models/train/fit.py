"""Train a detector on the CPU: seeded, resumable, with a progress bar and curves.

    python -m train.fit --data ../../shared/data/fire --out OUT [--extra DIR ...]
    python -m train.fit --network ember-seg --trunk ember-nano.onnx --still 4 ...
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from . import data, metrics
from .loss import losses, owners
from .model import INPUT, MEAN, NAMES, STD, EmberNano, cells, decode
from .nanodet import NanoDetM
from .seg import EmberSeg, mask_loss

Network = EmberNano | NanoDetM | EmberSeg
NETWORKS = {
    "ember-nano": EmberNano,
    "nanodet-m": NanoDetM,
    "ember-seg": EmberSeg,
    "ember-seg-attention": partial(EmberSeg, weighted=False),
    "ember-seg-weighted": partial(EmberSeg, attention=False),
    "ember-seg-plain": partial(EmberSeg, attention=False, weighted=False),
}


def normalise(images: Tensor) -> Tensor:
    """uint8 [B, 3, H, W] BGR -> float32, channels last."""
    mean, std = torch.tensor(MEAN).view(1, 3, 1, 1), torch.tensor(STD).view(1, 3, 1, 1)
    return ((images.float() - mean) / std).contiguous(memory_format=torch.channels_last)


@torch.no_grad()
def detect(model: Network, pictures: list[data.Picture], side: int = INPUT, batch: int = 16) -> list[metrics.Found]:
    """Detections in the px of each picture, letterboxed to side x side."""
    model.eval()
    centres, strides = cells(side, side, model.strides, model.within)
    out: list[metrics.Found] = []
    for i in range(0, len(pictures), batch):
        fitted = [data.letterbox(p.image, side) for p in pictures[i : i + batch]]
        images = torch.from_numpy(np.stack([f[0] for f in fitted])).permute(0, 3, 1, 2)
        y = model.logits(normalise(images))
        boxes = decode(y[..., model.nc :], centres, strides).numpy()
        for f, s, b in zip(fitted, y[..., : model.nc].sigmoid().numpy(), boxes):
            found = metrics.unpack(s, b)
            found.boxes = (found.boxes - (f[2], f[3], f[2], f[3])) / f[1]
            out.append(found)
    return out


def fire_ap(found: list[metrics.Found], pictures: list[data.Picture]) -> float:
    return metrics.average_precision(*metrics.match(found, [p.boxes for p in pictures], 0))


def thin(pictures: list[data.Picture], most: int) -> list[data.Picture]:
    """At most `most` pictures, evenly spaced."""
    return [pictures[i] for i in np.linspace(0, len(pictures) - 1, min(most, len(pictures))).astype(int)]


def curves(rows: list[dict[str, float]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    fig, axes = plt.subplots(1, 2, figsize=(10, 4))
    for k in (k for k in ("qfl", "dfl", "giou", "mask") if k in rows[0]):
        axes[0].plot([r["step"] for r in rows], [r[k] for r in rows], label=k)
    seen = [r for r in rows if "val" in r]
    for k in ("val", "synth", "extra"):
        if seen and k in seen[0]:
            axes[1].plot([r["step"] for r in seen], [r[k] for r in seen], label=f"fire AP50 {k}")
    for a in axes:
        a.set_xlabel("step"), a.legend(), a.grid(alpha=0.3)
    fig.tight_layout()
    fig.savefig(path)
    plt.close(fig)


def groups(model: Network, scratch: bool) -> list[dict]:
    """Parameters by weight decay and by share of the learning rate: what ImageNet taught moves slowly."""
    out = []
    for part, share in ((model.trunk, 1.0 if scratch else 0.3), (None, 1.0)):
        own = [p for n, p in model.named_parameters() if n.startswith("trunk.") == (part is not None)]
        own = [p for p in own if p.requires_grad]
        out += [
            {"params": [p for p in own if p.ndim > 1], "weight_decay": 0.02, "share": share},
            {"params": [p for p in own if p.ndim <= 1], "weight_decay": 0.0, "share": share},
        ]
    return out


def judged(
    model: Network, images: Tensor, boxes: Tensor, valid: Tensor, ids: Tensor, grid: tuple[Tensor, Tensor]
) -> dict[str, Tensor]:
    """The losses of a batch (see `data.Batches`), by name, and their sum as `total`."""
    owner = owners(boxes, grid)
    if not isinstance(model, EmberSeg):
        return losses(model.logits(normalise(images)), boxes, valid, model.nc, grid, owner)
    out, coefficients, prototypes = model.parts(normalise(images))
    parts = losses(out, boxes, valid, model.nc, grid, owner)
    parts["mask"] = mask_loss(coefficients, prototypes, boxes, ids, owner, images.shape[3])
    parts["total"] = parts["total"] + parts["mask"]
    return parts


def main() -> None:
    ap = argparse.ArgumentParser(description=__doc__)
    ap.add_argument("--data", type=Path, required=True, help="folder with manifest.csv and splits/")
    ap.add_argument("--out", type=Path, required=True, help="outside the project: checkpoints, log, curves")
    ap.add_argument("--extra", type=Path, action="append", default=[], help="more YOLO folders, e.g. simulated frames")
    ap.add_argument("--extra-share", type=float, default=data.SHARES["extra"], help="of the samples, from --extra")
    ap.add_argument("--thermal", action="store_true", help="learn ember-thermal: fire alone, on the thermal set")
    ap.add_argument("--network", choices=NETWORKS, default="ember-nano")
    ap.add_argument("--init", type=Path, help="start from the EMA weights of this checkpoint")
    ap.add_argument("--scratch", action="store_true", help="random weights instead of ImageNet's, for comparison")
    ap.add_argument("--trunk", type=Path, help="start the trunk from this ONNX file of ours instead of ImageNet's weights")
    ap.add_argument("--still", type=int, default=2, help="stages of the trunk that stay as they are")
    ap.add_argument("--steps", type=int, default=6000)
    ap.add_argument("--minutes", type=float, default=1e9,
                    help="of processor time; the schedule ends by then even if steps remain")
    ap.add_argument("--batch", type=int, default=24)
    ap.add_argument("--side", type=int, default=320, help="px of the training canvas, a multiple of 32")
    ap.add_argument("--lr", type=float, default=2e-3)
    ap.add_argument("--drawn", type=int, default=1500, help="procedural pictures")
    ap.add_argument("--every", type=int, default=300, help="steps between validations")
    ap.add_argument("--seed", type=int, default=1)
    ap.add_argument("--threads", type=int, default=2)
    ap.add_argument("--workers", type=int, default=1)
    args = ap.parse_args()
    if args.network == "nanodet-m" and not args.scratch:
        ap.error("nanodet-m has no ImageNet weights here: give --scratch")
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()

    sets = data.THERMAL_SETS if args.thermal else data.RGB_SETS
    if args.thermal:
        args.drawn = 0
    real = data.read_split(args.data, "train", sets)
    val = data.read_split(args.data, "val", sets)
    drawn = data.draw(args.drawn, args.seed, args.out.parent / f"drawn-{args.seed}-{args.drawn}.npz") if args.drawn else []
    check = data.draw(60, 10_000, args.out.parent / "drawn-check.npz") if args.drawn else []
    extra = [p for d in args.extra for p in data.read_yolo(d)]
    extra, extra_check = [p for i, p in enumerate(extra) if i % 12], extra[::12]
    print(f"train {len(real)}, drawn {len(drawn)}, extra {len(extra)}, val {len(val)}", flush=True)

    model = NETWORKS[args.network](1 if args.thermal else len(NAMES))
    if isinstance(model, EmberSeg):
        for p in real:
            data.guess_masks(p)
    if args.trunk:
        shown = [data.letterbox(p.image, args.side)[0] for p in thin(real, 48)]
        model.trunk.start_from_onnx(args.trunk, normalise(torch.from_numpy(np.stack(shown)).permute(0, 3, 1, 2)))
    elif not args.scratch:
        model.trunk.start_from_imagenet()
    model = model.to(memory_format=torch.channels_last)
    still = [] if args.scratch else model.trunk.frozen(args.still)
    for part in still:
        part.requires_grad_(False)
    optimiser = torch.optim.AdamW(groups(model, args.scratch), lr=args.lr, betas=(0.9, 0.99))
    step, spent, best, rows = 0, 0.0, -1.0, []
    last = args.out / "last.pt"
    if last.exists():
        state = torch.load(last, map_location="cpu", weights_only=True)
        model.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        step, spent, best, rows = state["step"], state["spent"], state["best"], json.loads(state["rows"])
    elif args.init:
        model.load_state_dict(torch.load(args.init, map_location="cpu", weights_only=True)["ema"])
    ema = copy.deepcopy(model).eval()
    if last.exists():
        ema.load_state_dict(state["ema"])

    others = (1 - args.extra_share) / (1 - data.SHARES["extra"])
    shares = {k: v * others for k, v in data.SHARES.items()} | {"extra": args.extra_share}
    mixer = data.Mixer(real, drawn, extra, args.side, not args.thermal, shares)
    loader = torch.utils.data.DataLoader(
        data.Batches(mixer, args.batch, args.seed, step), batch_size=None, num_workers=args.workers,
        prefetch_factor=4 if args.workers else None,
    )
    batches = iter(loader)
    grid = cells(args.side, args.side, model.strides, model.within)
    began = time.process_time() - spent
    warm = min(200, args.steps // 8 + 1)
    bar = tqdm(total=args.steps, initial=step, mininterval=20)
    sums: dict[str, float] = {}
    since = 0
    done = 0.0
    while done < 1.0:
        images, boxes, valid, ids = next(batches)
        spent = time.process_time() - began
        done = max((step + 1) / args.steps, spent / 60 / args.minutes)
        rate = args.lr * min(1.0, (step + 1) / warm) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(done, 1))))
        for g in optimiser.param_groups:
            g["lr"] = rate * g["share"]
        model.train()
        for part in still:
            part.eval()  # batch statistics stay ImageNet's too
        parts = judged(model, images, boxes, valid, ids, grid)
        optimiser.zero_grad()
        parts["total"].backward()
        nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimiser.step()
        step += 1
        keep = min(0.998, step / (step + 20))
        with torch.no_grad():
            for e, m in zip(ema.state_dict().values(), model.state_dict().values()):
                e.lerp_(m, 1 - keep) if e.is_floating_point() else e.copy_(m)
        for k, v in parts.items():
            sums[k] = sums.get(k, 0.0) + float(v.detach())
        since += 1
        bar.update()
        if step % args.every == 0 or done >= 1.0:
            row = {"step": step, "minutes": spent / 60, "lr": rate} | {k: v / since for k, v in sums.items()}
            sums, since = {}, 0
            pool = val if done >= 1.0 else thin(val, 150)
            row["val"] = fire_ap(detect(ema, pool), pool)
            if check:
                row["synth"] = fire_ap(detect(ema, check), check)
            if extra_check:
                row["extra"] = fire_ap(detect(ema, thin(extra_check, 40), 640), thin(extra_check, 40))
            rows.append(row)
            print("\n" + " ".join(f"{k} {v:.4g}" for k, v in row.items()), flush=True)
            curves(rows, args.out / "curves.png")
            state = {"model": model.state_dict(), "ema": ema.state_dict(), "optimiser": optimiser.state_dict(),
                     "classes": model.nc, "network": args.network, "scratch": args.scratch, "step": step,
                     "spent": spent, "seed": args.seed, "rows": json.dumps(rows)}
            better = row["val"] >= best
            best = max(best, row["val"])
            state["best"] = best
            torch.save(state, last.with_suffix(".tmp"))
            last.with_suffix(".tmp").replace(last)
            if better:
                torch.save({"ema": ema.state_dict(), "classes": model.nc, "network": args.network,
                            "scratch": args.scratch, "seed": args.seed, "step": step}, args.out / "best.pt")
    bar.close()
    print(f"done in {(time.monotonic() - started) / 60:.1f} min, best val fire AP50 {best:.3f}")


if __name__ == "__main__":
    main()
