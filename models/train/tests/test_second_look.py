"""What counts as burning, what the network is shown of it, and that the file computes what was trained."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import torch

from train import second_look as look


def test_a_part_of_its_own_kind_burns_and_a_touch_does_not() -> None:
    truth = np.array([[0, 100, 100, 140, 160]], np.float32)
    tongue, beside, all_of_it = np.array([110, 100, 125, 120]), np.array([139, 150, 200, 190]), np.array([98, 95, 143, 163])
    assert look.burns(0, tongue, truth) and not look.burns(1, tongue, truth)
    assert not look.burns(0, beside, truth) and look.burns(1, all_of_it, truth)
    assert not look.burns(0, tongue, truth[:0])


def test_a_box_stands_in_the_middle_of_what_is_cut_out_and_beyond_the_edge_the_edge_goes_on() -> None:
    image = np.zeros((100, 100, 3), np.uint8)
    image[40:60, 40:60] = 255
    cut = look.cut(image, np.array([40, 40, 60, 60]))
    share = (cut[..., 0] > 127).mean()
    assert cut.shape == (look.SIDE, look.SIDE, 3) and abs(share - 1 / look.MARGIN**2) < 0.03
    assert (np.argwhere(cut[..., 0] > 127).mean(0) - (look.SIDE - 1) / 2 < 0.6).all()
    image[:, :3] = 200
    assert look.cut(image, np.array([-60, 40, -20, 60])).min() == 200


def test_the_area_under_the_curve_is_that_of_all_pairs() -> None:
    rng = np.random.default_rng(2)
    truth, score = rng.integers(0, 2, 60), rng.normal(size=60)
    pairs = score[truth == 1][:, None] > score[truth == 0][None]
    assert abs(look.ranked(score, truth) - pairs.mean()) < 1e-12


def test_the_file_computes_what_was_trained_for_any_number_of_looks(tmp_path: Path) -> None:
    torch.manual_seed(4)
    model = look.EmberLook().eval()
    model.middle.data.normal_(), model.spread.data.uniform_(0.5, 2)
    look.export(model, tmp_path / "look.onnx", 4)
    session = onnxruntime.InferenceSession(str(tmp_path / "look.onnx"), providers=["CPUExecutionProvider"])
    for count in (1, 5):
        looks = torch.randn(count, 3, look.SIDE, look.SIDE)
        with torch.no_grad():
            want = model(looks).numpy()
        assert np.abs(session.run(None, {"looks": looks.numpy()})[0] - want).max() < 1e-4
