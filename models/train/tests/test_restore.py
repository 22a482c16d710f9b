"""A network that was folded into an ONNX file comes back as one that can be trained on."""

from __future__ import annotations

from pathlib import Path

import torch

from train.export import export
from train.fit import normalise
from train.model import INPUT, EmberNano
from train.restore import folded, restore


def test_a_restored_network_computes_what_the_file_computes_and_its_batch_norms_are_those_of_pictures(
    tmp_path: Path,
) -> None:
    torch.manual_seed(3)
    shipped = EmberNano().eval()
    with torch.no_grad():
        for number in shipped.parameters():
            number.add_(torch.randn_like(number) * 0.01)  # else equal ones are written once
        for norm in (m for m in shipped.modules() if isinstance(m, torch.nn.BatchNorm2d)):
            norm.running_mean.normal_(0, 0.3), norm.running_var.uniform_(0.5, 2.0), norm.bias.normal_(0, 0.3)
    path = tmp_path / "shipped.onnx"
    export(shipped, path, {"fire": 0.5, "smoke": 0.5}, "0", 0)
    images = torch.randint(0, 256, (4, 3, 128, 128), dtype=torch.uint8)
    again = restore(EmberNano(), folded(path), images)
    x = torch.randn(1, 3, INPUT, INPUT)
    with torch.no_grad():
        assert (again(x) - shipped(x)).abs().max() < 1e-3
    # By the statistics of its own batch it computes the same: so training goes on from where it was.
    x = normalise(images)
    with torch.no_grad():
        still = again.logits(x)
        moving = again.train().logits(x)
    assert (moving - still).abs().max() < 2e-2 * still.abs().max()
