"""A checkpoint to go on from, out of a shipped ONNX file, whose batch norms were folded into the convolutions.

    python -m train.restore ember-nano.onnx --data DATA --out nano.pt     # then: python -m train.fit --init nano.pt

A folded convolution has a weight and a bias; a batch norm has four numbers per channel, of which mean and variance
are those of what its convolution puts out. They are measured on training pictures, and scale and shift are chosen
such that the network computes what the file computes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from . import data
from .fit import normalise
from .model import INPUT, NAMES, EmberNano


def folded(path: Path) -> list[tuple[Tensor, Tensor]]:
    """Weight and bias of each convolution, in the order in which they are computed."""
    graph = onnx.load(str(path)).graph
    values = {i.name: torch.from_numpy(numpy_helper.to_array(i).copy()) for i in graph.initializer}
    return [(values[n.input[1]], values[n.input[2]]) for n in graph.node if n.op_type == "Conv"]


def called(model: nn.Module, sample: Tensor) -> list[tuple[nn.Conv2d, nn.BatchNorm2d | None]]:
    """Each convolution with the batch norm that follows it, in the order in which they are computed."""
    order: list[nn.Module] = []
    parts = [m for m in model.modules() if isinstance(m, (nn.Conv2d, nn.BatchNorm2d))]
    hooks = [m.register_forward_hook(lambda m, *_: order.append(m)) for m in parts]
    model(sample)
    for hook in hooks:
        hook.remove()
    followed = zip(order, [*order[1:], None])
    return [
        (conv, after if isinstance(after, nn.BatchNorm2d) else None)
        for conv, after in followed
        if isinstance(conv, nn.Conv2d)
    ]


@torch.no_grad()
def restore(model: EmberNano, weights: list[tuple[Tensor, Tensor]], images: Tensor) -> EmberNano:
    """Give the model the folded weights; images uint8 [B, 3, H, W] tell the statistics of its batch norms."""
    model.eval()
    images = normalise(images)
    layers = called(model, images[:1])
    if [c.weight.shape for c, _ in layers] != [w.shape for w, _ in weights]:
        raise ValueError("the file holds another network")
    for (conv, norm), (weight, bias) in zip(layers, weights):
        conv.weight.copy_(weight)
        if norm is None:
            conv.bias.copy_(bias)
            continue
        norm.running_mean.zero_(), norm.running_var.fill_(1 - norm.eps)
        norm.weight.fill_(1.0), norm.bias.copy_(bias)
    told: dict[nn.BatchNorm2d, tuple[Tensor, Tensor]] = {}

    def note(norm: nn.BatchNorm2d, inputs: tuple[Tensor], _: Tensor) -> None:
        told[norm] = inputs[0].mean((0, 2, 3)), inputs[0].var((0, 2, 3))

    norms = [norm for _, norm in layers if norm is not None]
    hooks = [norm.register_forward_hook(note) for norm in norms]
    model(images)
    for hook in hooks:
        hook.remove()
    for norm in norms:
        mean, variance = told[norm]
        norm.running_mean.copy_(mean), norm.running_var.copy_(variance)
        norm.weight.copy_((variance + norm.eps).sqrt()), norm.bias.add_(mean)
    return model


def main() -> None:
    ap = argparse.ArgumentParser(description=__doc__)
    ap.add_argument("model", type=Path, help="ember-nano.onnx or ember-thermal.onnx")
    ap.add_argument("--data", type=Path, required=True, help="folder with manifest.csv and splits/")
    ap.add_argument("--out", type=Path, required=True)
    ap.add_argument("--thermal", action="store_true")
    ap.add_argument("--pictures", type=int, default=48)
    args = ap.parse_args()
    torch.manual_seed(0)
    real = data.read_split(args.data, "train", data.THERMAL_SETS if args.thermal else data.RGB_SETS)
    chosen = [real[i] for i in np.linspace(0, len(real) - 1, args.pictures).astype(int)]
    images = torch.from_numpy(np.stack([data.letterbox(p.image, INPUT)[0] for p in chosen])).permute(0, 3, 1, 2)
    model = restore(EmberNano(1 if args.thermal else len(NAMES)), folded(args.model), images)
    torch.save({"ema": model.state_dict(), "classes": model.nc, "seed": 0, "step": 0}, args.out)
    print(f"{args.out}: {len(chosen)} pictures told the batch norms")


if __name__ == "__main__":
    main()
