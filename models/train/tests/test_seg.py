"""Checks of ember-seg: its two ideas, its masks, its file. Needs no pictures on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from train import data, masks, synth
from train.export import export
from train.fit import NETWORKS, judged
from train.loss import owners
from train.model import INPUT, cells
from train.nanodet import NanoDetM
from train.seg import ChannelAttention, EmberSeg, Fusion, TwoWays, mask_loss
from train.trunk import Trunk

MODELS = Path(__file__).resolve().parents[2]


def awake(model: torch.nn.Module) -> torch.nn.Module:
    """Random but lively: what a fresh network gives is nearly the same everywhere."""
    torch.manual_seed(3)
    for m in model.modules():
        if isinstance(m, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(m.weight, 0.5, 1.5), torch.nn.init.normal_(m.bias, std=0.5)
            torch.nn.init.normal_(m.running_mean, std=0.2), torch.nn.init.uniform_(m.running_var, 0.5, 1.5)
        if isinstance(m, Fusion):
            torch.nn.init.uniform_(m.weight, -0.5, 2.0)
    return model.eval()


def test_attention_is_the_sigmoid_of_neighbouring_means() -> None:
    for channels, reach in ((40, 3), (112, 3), (192, 5), (512, 5)):
        attend = ChannelAttention(channels)
        kernel = attend.mix.weight.detach().numpy().ravel()
        assert len(kernel) == reach, channels
        x = torch.randn(2, channels, 5, 7) + torch.randn(2, channels, 1, 1)
        means = np.pad(x.numpy().mean((2, 3)), ((0, 0), (reach // 2, reach // 2)))
        mixed = np.stack([means[:, c : c + reach] @ kernel for c in range(channels)], 1)
        want = x.numpy() / (1 + np.exp(-mixed))[..., None, None]
        assert np.abs(attend(x).detach().numpy() - want).max() < 1e-5


def test_weights_of_a_fusion_are_shares() -> None:
    fuse = Fusion(3)
    fuse.body = torch.nn.Identity()
    maps = [torch.full((1, 72, 4, 4), v) for v in (1.0, 10.0, 100.0)]
    assert abs(float(fuse(*maps).mean().detach()) - 37.0) < 0.01
    with torch.no_grad():
        fuse.weight.copy_(torch.tensor([3.0, -5.0, 1.0]))
    shares = fuse.shares()
    assert float(shares.min()) == 0 and abs(float(shares.sum()) - 1) < 1e-4
    assert abs(float(fuse(*maps).mean().detach()) - (0.75 * 1 + 0.25 * 100)) < 0.01


def test_the_pyramid_goes_both_ways() -> None:
    """Without convolutions, on constant maps, every fused value can be worked out by hand."""
    once = TwoWays(3, 3)
    for fuse in (*once.down, *once.up):
        fuse.body = torch.nn.Identity()
    maps = [torch.full((1, 72, s, s), v) for s, v in ((8, 8.0), (4, 4.0), (2, 0.0))]
    out = [float(m.mean()) for m in once(maps)]
    mid = (4 + 0) / 2
    fine = (8 + mid) / 2
    middle = (4 + mid + fine) / 3
    assert np.abs(np.array(out) - (fine, middle, (0 + middle) / 2)).max() < 1e-2
    assert [m.shape[-1] for m in once(maps)] == [8, 4, 2]


def test_every_variant_keeps_the_contract_and_the_size() -> None:
    for name, make in NETWORKS.items():
        if not name.startswith("ember-seg"):
            continue
        model = make(2).eval()
        assert sum(p.numel() for p in model.parameters()) < 1.6e6, name
        with torch.no_grad():
            rows, prototypes = model(torch.zeros(1, 3, INPUT, INPUT))
        assert rows.shape == (1, 4 + 2 + 32, 3549) and prototypes.shape == (1, 32, 104, 104), name


def test_nanodet_has_the_public_size() -> None:
    """0.95 M parameters with COCO's 80 classes."""
    assert round(sum(p.numel() for p in NanoDetM(80).parameters()) / 1e6, 2) == 0.95


def test_boxes_agree_with_a_plain_computation() -> None:
    model = awake(EmberSeg())
    x = torch.randn(1, 3, 96, 128)
    with torch.no_grad():
        rows, _ = model(x)
        raw, coefficients, _ = model.parts(x)
    raw = raw[0].numpy().astype(np.float64)
    k = 0
    for stride in (8, 16, 32):
        for y in range(96 // stride):
            for x_ in range(128 // stride):
                bins = np.exp(raw[k, 2:].reshape(4, 8))
                side = (bins * np.arange(8)).sum(1) / bins.sum(1) * stride
                left, top = x_ * stride - side[0], y * stride - side[1]
                right, bottom = x_ * stride + side[2], y * stride + side[3]
                want = [(left + right) / 2, (top + bottom) / 2, right - left, bottom - top]
                want += list(1 / (1 + np.exp(-raw[k, :2])))
                got = rows[0, :, k].numpy()
                assert np.abs(got[:6] - want).max() < 1e-3
                assert np.array_equal(got[6:], coefficients[0, k].numpy())
                k += 1
    assert k == rows.shape[2]


def test_files_say_what_the_networks_say(tmp_path: Path) -> None:
    for model in (awake(EmberSeg()), awake(NanoDetM())):
        path = tmp_path / "model.onnx"
        worst = export(model, path, {"fire": 0.5, "smoke": 0.5}, "0.0.0", 1, "")
        assert worst < 1e-3, worst
        assert path.stat().st_size < 8e6
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        assert session.get_modelmeta().custom_metadata_map["family"] == model.family
        got = session.run(None, {session.get_inputs()[0].name: np.zeros((1, 3, INPUT, INPUT), np.float32)})
        if model.family == "nanodet":
            assert [g.shape for g in got] == [(1, n, w) for w in (2, 32) for n in (2704, 676, 169)]


def test_a_mask_where_it_should_be_costs_nearly_nothing() -> None:
    """One prototype that is the mask, at a quarter of the picture: the loss tells it from its mirror image."""
    side = 64
    ids = torch.zeros(1, side, side, dtype=torch.uint8)
    ids[0, 16:32, 8:40] = 1
    boxes = torch.tensor([[[0.0, 8, 16, 40, 32]]])
    owner = owners(boxes, cells(side, side, (8, 16, 32)))
    assert int((owner == 0).sum()) > 0
    coefficients = torch.zeros(1, owner.shape[1], 32)
    coefficients[..., 0] = 1
    prototypes = torch.zeros(1, 32, side // 4, side // 4)
    prototypes[0, 0] = torch.where(ids[0, 2::4, 2::4] > 0, 12.0, -12.0)
    good = float(mask_loss(coefficients, prototypes, boxes, ids, owner, side))
    bad = float(mask_loss(coefficients, prototypes.flip(3), boxes, ids, owner, side))
    # What is left is the interpolated border.
    assert good < 0.2 < 1 < bad, (good, bad)
    assert float(mask_loss(coefficients, prototypes, boxes, ids * 0, owner, side)) == 0


def test_outlines_enclose_their_pixels() -> None:
    rng = np.random.default_rng(4)
    for share in (0.05, 0.4, 0.6, 0.95):
        mask = rng.random((13, 20)) < share
        assert np.array_equal(masks.fill(masks.outline(mask), 13, 20), mask)
    # A triangle of 40 x 30 px, its middles counted by the plain inequality.
    y, x = np.mgrid[:30, :40] + 0.5
    assert np.array_equal(masks.fill(np.array([[0, 0], [40, 0], [0, 30]]), 30, 40), x / 40 + y / 30 < 1)


def test_a_label_file_gives_its_masks_back(tmp_path: Path) -> None:
    synth.write(tmp_path, 4, 7)
    read, drawn = data.read_yolo(tmp_path), data.draw(4, 7)
    assert sum(len(p.boxes) for p in drawn) > 2
    for a, b in zip(read, drawn, strict=True):
        assert np.array_equal(a.image, b.image)
        assert np.allclose(a.boxes, b.boxes, atol=1e-3)
        assert a.ids is None or np.array_equal(a.ids, b.ids)


def test_samples_carry_their_masks() -> None:
    drawn = data.draw(8, 3)
    mixer = data.Mixer(drawn, drawn, [], 128)
    seen = 0
    for seed in range(60):
        _, boxes, _, ids = mixer.sample(np.random.default_rng(seed))
        for k, (cls, *box) in enumerate(boxes):
            y, x = np.nonzero(ids == k + 1)
            if cls == 0 and len(x) > 30:
                seen += 1
                # Nothing of a flame lies outside its box by more than what rounding moves.
                assert x.min() > box[0] - 2 and x.max() < box[2] + 1 and y.min() > box[1] - 2 and y.max() < box[3] + 1
    assert seen > 10


def test_a_trunk_taken_from_a_file_does_what_the_file_does() -> None:
    """The batch norms that come back change nothing, and say what the pictures show."""
    ours = Trunk()
    pictures = torch.randn(2, 3, 64, 64)
    ours.start_from_onnx(MODELS / "ember-nano.onnx", pictures)
    session_input = torch.randn(1, 3, INPUT, INPUT)
    graph = onnx.load(str(MODELS / "ember-nano.onnx"))
    convs = [n for n in graph.graph.node if n.op_type == "Conv"]
    layers = [m for m in ours.modules() if isinstance(m, torch.nn.Sequential) and isinstance(m[0], torch.nn.Conv2d)]
    name = convs[len(layers) - 1].output[0]  # the last of the trunk, which has no activation
    graph.graph.output.append(onnx.helper.make_empty_tensor_value_info(name))
    session = onnxruntime.InferenceSession(graph.SerializeToString(), providers=["CPUExecutionProvider"])
    want = session.run([name], {"data": session_input.numpy()})[0]
    with torch.no_grad():
        got = ours.eval()(session_input)[2].numpy()
    assert np.abs(got - want).max() < 1e-3 * np.abs(want).max()
    # The first layer's statistics, worked out from the file's weights.
    with torch.no_grad():
        means = torch.nn.functional.conv2d(pictures, ours.stem[0].weight, None, 2, 1).mean((0, 2, 3))
    assert torch.allclose(ours.stem[1].running_mean, means, atol=1e-5)


def test_a_batch_is_learned() -> None:
    """Twelve steps on one batch: the losses of sides, boxes and masks fall, and nothing is left without a gradient."""
    drawn = data.draw(8, 3)
    batch = next(iter(data.Batches(data.Mixer(drawn, drawn, [], 128), 4, 1)))
    torch.manual_seed(1)
    for name in ("ember-seg", "nanodet-m"):
        model = NETWORKS[name](2).train()
        grid = cells(128, 128, model.strides, model.within)
        optimiser = torch.optim.AdamW(model.parameters(), lr=2e-3)
        history = []
        for _ in range(12):
            parts = judged(model, *batch, grid)
            optimiser.zero_grad()
            parts["total"].backward()
            optimiser.step()
            history.append({k: float(v.detach()) for k, v in parts.items()})
        assert all(p.grad is not None for p in model.parameters()), name
        # The scores' loss may rise at first: they have more to say of boxes that fit better.
        for kind in history[0].keys() & {"dfl", "giou", "mask"}:
            assert history[-1][kind] < 0.9 * history[0][kind], (name, kind, history)
