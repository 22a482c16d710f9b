"""Checks of decoding, scoring, assignment and data handling; needs no pictures on disk."""

from __future__ import annotations

import copy

import numpy as np
import torch

from train import data, metrics, synth
from train.evaluate import starts
from train.loss import assign, iou, losses
from train.model import BINS, INPUT, EmberNano, cells, decode
from train.trunk import Trunk


def test_output_shape_and_cell_order() -> None:
    centres, strides = cells(INPUT, INPUT)
    assert centres.shape == (3598, 2)
    assert centres[1].tolist() == [8.0, 0.0] and centres[52].tolist() == [0.0, 8.0]
    assert strides[2704] == 16 and strides[-1] == 64 and centres[-1].tolist() == [384.0, 384.0]
    with torch.no_grad():
        y = EmberNano().eval()(torch.zeros(1, 3, INPUT, INPUT))
    assert y.shape == (1, 3598, 2 + 4 * BINS)
    assert 0 <= float(y[..., :2].min()) and float(y[..., :2].max()) <= 1


def test_the_trunk_sees_what_the_published_one_sees() -> None:
    """With TensorFlow's padding (far side only) in the place of ours, a picture that lies further right
    and down by what each stride shifts gives the same maps, away from the borders."""
    ours = Trunk().eval()
    ours.start_from_imagenet()
    theirs = copy.deepcopy(ours)
    for m in theirs.modules():
        if isinstance(m, torch.nn.Conv2d) and m.stride == (2, 2):
            near = (m.kernel_size[0] - 2) // 2
            m.register_forward_pre_hook(lambda m, x, n=near: (torch.nn.functional.pad(x[0], (n, n + 1, n, n + 1)),))
            m.padding = (0, 0)
    picture = torch.rand(1, 3, 512, 512)
    shifts = {8: 7, 16: 15, 32: 31}
    for i, (stride, shift) in enumerate(shifts.items()):
        a = ours(picture)[i]
        b = theirs(torch.roll(picture, (shift, shift), (2, 3)))[i]
        mid = slice(a.shape[2] // 2 - 1, a.shape[2] // 2 + 1)
        assert torch.allclose(a[..., mid, mid], b[..., mid, mid], atol=1e-3 * float(a.abs().max())), stride


def test_decode_of_certain_bins() -> None:
    logits = torch.full((1, 4, BINS), -50.0)
    for side, n in enumerate((1, 2, 3, 4)):
        logits[0, side, n] = 50.0
    box = decode(logits.flatten(1), torch.tensor([[80.0, 40.0]]), torch.tensor([8.0]))
    assert torch.allclose(box, torch.tensor([[72.0, 24.0, 104.0, 72.0]]))


def test_iou() -> None:
    a, b = torch.tensor([0.0, 0, 2, 2]), torch.tensor([1.0, 0, 3, 2])
    assert abs(float(iou(a, b)) - 1 / 3) < 1e-6
    assert float(iou(a, a + 10, True)) < 0


def test_nms_and_ap() -> None:
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [50, 50, 60, 60]], np.float32)
    assert metrics.nms(boxes, np.array([0.8, 0.9, 0.5])).tolist() == [1, 2]
    truth = [np.array([[0, 0, 0, 10, 10], [0, 50, 50, 60, 60]], np.float32)]
    found = [metrics.Found(boxes[[0, 2]], np.array([0.9, 0.4]), np.array([0, 0]))]
    assert metrics.average_precision(*metrics.match(found, truth, 0)) == 1.0
    found = [metrics.Found(np.array([[90, 90, 99, 99], [0, 0, 10, 10]], np.float32), np.array([0.9, 0.8]), np.zeros(2))]
    assert abs(metrics.average_precision(*metrics.match(found, truth, 0)) - 0.25) < 1e-9
    assert metrics.match(found, truth, 1)[2] == 0


def test_every_box_gets_a_cell() -> None:
    centres, strides = cells(320, 320)
    boxes = torch.tensor([[1.0, 1.0, 5.0, 6.0], [100.0, 100.0, 300.0, 310.0], [33.0, 33.0, 39.0, 39.0]])
    owner = assign(boxes, centres, strides)
    assert set(range(3)) <= set(owner.tolist())


def test_masked_smoke_costs_nothing() -> None:
    out = torch.zeros(1, len(cells(64, 64)[1]), 34, requires_grad=True)
    boxes = torch.full((1, 1, 5), -1.0)
    owner = torch.full(out.shape[:2], -1)
    losses(out, boxes, torch.ones(1, 8, 8, dtype=torch.uint8), 2, cells(64, 64), owner)["total"].backward()
    assert float(out.grad[..., 0].abs().min()) > 0 and float(out.grad[..., 1].abs().max()) == 0


def test_letterbox_round_trip() -> None:
    _, s, x, y = data.letterbox(np.zeros((720, 1280, 3), np.uint8), INPUT)
    assert (x, y) == (0, 91) and abs(1280 * s - INPUT) < 1e-6


def test_tiles_cover_the_frame() -> None:
    for length in (300, 416, 417, 720, 1280):
        s = starts(length, 64)
        assert s[0] == 0 and s[-1] + INPUT >= length
        assert all(b - a <= INPUT - 64 for a, b in zip(s, s[1:]))


def test_drawn_pictures_repeat_and_samples_fit() -> None:
    a, b = (synth.scene(np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1])
    drawn = data.draw(6, 3)
    drawn.append(data.Picture(np.full((50, 50, 3), 90, np.uint8), np.zeros((0, 5), np.float32), True, "x", "x/1"))
    mixer = data.Mixer(drawn, drawn, [], 128)
    mixer.fires = drawn
    for seed in range(12):
        image, boxes, valid, ids = mixer.sample(np.random.default_rng(seed))
        assert image.shape == (128, 128, 3) and valid.shape == (16, 16) and ids.shape == (128, 128)
        assert (boxes[:, 1:] >= 0).all() and (boxes[:, 1:] <= 128).all()
