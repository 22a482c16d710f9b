"""Tiny detectors of every family, and what they find, computed without a line of ours.

    detector_families.py FOLDER [--seed N]

writes FOLDER/NAME.onnx (random weights over averaged pixels, so that the answer depends on the picture),
FOLDER/SIDE.png and FOLDER/truth.json: per model its picture, a threshold that some hundred boxes reach, and
what is left of these after class-wise suppression, surest first: [left, top, right, bottom, score, class] in
pixels of the picture, their centres at whole numbers, and masks where it has them. The graphs are run by
`onnx`'s reference evaluator, in NumPy. FOLDER/set is a data set for the segmenting one: pictures, and labels
with outlines near some of what it finds in them.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

NAMES = ["fire", "smoke"]
# Boxes that compete, and the overlap from which the surer one stays.
MOST, OVERLAP = 300, 0.5
MEAN, STD = np.array([103.53, 116.28, 123.675]), np.array([57.375, 57.12, 58.395])
ANCHORS = {
    "yolov3-tiny": {16: [(10, 14), (23, 27), (37, 58)], 32: [(81, 82), (135, 169), (344, 319)]},
    "yolov4-tiny": {16: [(23, 27), (37, 58), (81, 82)], 32: [(81, 82), (135, 169), (344, 319)]},
    "yolov3": {
        8: [(10, 13), (16, 30), (33, 23)],
        16: [(30, 61), (62, 45), (59, 119)],
        32: [(116, 90), (156, 198), (373, 326)],
    },
    "yolov4": {
        8: [(12, 16), (19, 36), (40, 28)],
        16: [(36, 75), (76, 55), (72, 146)],
        32: [(142, 110), (192, 243), (459, 401)],
    },
}
GROWN = {"yolov4-tiny": {16: 1.05, 32: 1.05}, "yolov4": {8: 1.2, 16: 1.1, 32: 1.05}}


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x, np.float64)))


class Graph:
    """Nodes and weights of one model, gathered on the way."""

    def __init__(self, side, rng, name="images"):
        self.side, self.rng, self.name = side, rng, name
        self.nodes, self.weights, self.outputs = [], [], []

    def weight(self, values, name=None):
        name = name or f"w{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def node(self, kind, inputs, name=None, **attributes):
        name = name or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def cells(self, stride, channels, spread, bias):
        """Averages of stride by stride pixels, mixed linearly: [1, channels, rows, columns]."""
        mean = self.node("AveragePool", [self.name], kernel_shape=[stride, stride], strides=[stride, stride])
        scale = self.rng.normal(0, 1, (channels, 3, 1, 1)) * np.asarray(spread).reshape(-1, 1, 1, 1)
        offset = np.broadcast_to(bias, channels).astype(np.float32)
        return self.node("Conv", [mean, self.weight(scale.astype(np.float32)), self.weight(offset)])

    def rows(self, maps):
        """[1, c, h, w] to [1, h * w, c]."""
        shape = self.weight(np.array([0, 0, -1], np.int64))
        flat = self.node("Reshape", [maps, shape])
        return self.node("Transpose", [flat], perm=[0, 2, 1])

    def output(self, tensor, shape, name):
        self.node("Identity", [tensor], name)
        self.outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))

    def model(self, metadata, weights_as_inputs=False, opset=17):
        shape = [1, 3, self.side, self.side]
        inputs = [helper.make_tensor_value_info(self.name, TensorProto.FLOAT, shape)]
        if weights_as_inputs:
            inputs += [helper.make_tensor_value_info(w.name, w.data_type, w.dims) for w in self.weights]
        graph = helper.make_graph(self.nodes, "tiny", inputs, self.outputs, self.weights)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
        for key, value in metadata.items():
            entry = model.metadata_props.add()
            entry.key, entry.value = key, value
        onnx.checker.check_model(model)
        return model


def grid(side, strides):
    """Column, row and stride of every cell."""
    parts = []
    for stride in strides:
        n = -(-side // stride)
        row, column = np.divmod(np.arange(n * n), n)
        parts.append(np.stack([column, row, np.full(n * n, stride)], 1))
    return np.concatenate(parts).astype(np.float64)


def about(middle, size):
    return np.concatenate([middle - size / 2, middle + size / 2], 1)


def scored(boxes, scores):
    """Rows [box, score, class], each of its best class."""
    best = scores.argmax(1)
    return np.column_stack([boxes, scores[np.arange(len(best)), best], best])


def suppressed(rows):
    """The threshold in the widest gap that lets about MOST rows compete, and the indices of those that stay."""
    order = np.argsort(-rows[:, 4], kind="stable")
    most = min(MOST, len(order) - 1)
    scores = rows[order[: most + 1], 4]
    most = most // 2 + int(np.argmax(-np.diff(scores[most // 2 :]))) + 1
    threshold = scores[most - 1 : most + 1].mean()
    kept = []
    for index in order[:most]:
        box, label = rows[index, :4], rows[index, 5]
        if box[2] <= box[0] or box[3] <= box[1]:
            continue
        if all(rows[other, 5] != label or iou(box, rows[other, :4]) <= OVERLAP for other in kept):
            kept.append(index)
    return threshold, kept


def iou(a, b):
    across = min(a[2], b[2]) - max(a[0], b[0])
    down = min(a[3], b[3]) - max(a[1], b[1])
    both = max(across, 0) * max(down, 0)
    return both / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both)


def bins(logits, strides):
    logits = logits.astype(np.float64).reshape(len(logits), 4, 8)
    weight = np.exp(logits - logits.max(-1, keepdims=True))
    return (weight / weight.sum(-1, keepdims=True)) @ np.arange(8) * strides[:, None]


def sided(cells, within, sides):
    middle = (cells[:, :2] + within) * cells[:, 2:]
    return np.concatenate([middle - sides[:, :2], middle + sides[:, 2:]], 1)


# ---- One function a form: the graph, and what its outputs mean --------------------------------------------


def nanodet(rng, form):
    g = Graph(416, rng, "input.1" if form == "a" else "image")
    scores, sides, shapes = [], [], []
    for stride in (8, 16, 32):
        n = 416 // stride
        scores.append(g.node("Sigmoid", [g.rows(g.cells(stride, 2, 1.5, -1.5))]))
        sides.append(g.rows(g.cells(stride, 32, 3.0, 0.0)))
        shapes.append(n * n)
    if form == "b":
        scores, sides = ([g.node("Squeeze", [t], axes=[0]) for t in part] for part in (scores, sides))
        # Declared names that lie, as seen in the wild.
        names = ["cls_score0", "bbox_pred0", "cls_score1", "bbox_pred1", "cls_score2", "bbox_pred2"]
    else:
        names = ["792", "814", "836", "795", "817", "839"]
    front = [1] if form == "a" else []
    for tensor, cells, wide, name in zip(scores + sides, shapes * 2, [2] * 3 + [32] * 3, names):
        g.output(tensor, [*front, cells, wide], name)
    model = g.model({"family": "nanodet"}, weights_as_inputs=form == "a", opset=11 if form == "a" else 12)

    def decode(out):
        out = [o.reshape(-1, o.shape[-1]) for o in out]
        cells = grid(416, (8, 16, 32))
        return scored(sided(cells, 0.5, bins(np.concatenate(out[3:]), cells[:, 2])), np.concatenate(out[:3]))

    return model, decode, (MEAN, STD, False)


def nanodet_plus(rng, _form):
    g = Graph(416, rng, "data")
    rows = []
    for stride in (8, 16, 32, 64):
        n = -(-416 // stride)
        padded = g.name
        if 416 % stride:
            pads = g.weight(np.array([0, 0, 0, 0, 0, 0, n * stride - 416, n * stride - 416], np.int64))
            padded = g.node("Pad", [g.name, pads])
        saved, g.name = g.name, padded
        scores = g.node("Sigmoid", [g.cells(stride, 2, 1.5, -1.5)])
        logits = g.cells(stride, 32, 3.0, 0.0)
        g.name = saved
        rows.append(g.rows(g.node("Concat", [scores, logits], axis=1)))
    g.output(g.node("Concat", rows, axis=1), [1, 3598, 34], "output")

    def decode(out):
        cells = grid(416, (8, 16, 32, 64))
        return scored(sided(cells, 0.0, bins(out[0][0][:, 2:], cells[:, 2])), out[0][0][:, :2])

    return g.model({"family": "nanodet-plus"}), decode, (MEAN, STD, False)


UNIT = (np.zeros(3), np.full(3, 255.0), True)


def yolov5(rng, _form):
    g, rows = Graph(320, rng), []
    for stride in (8, 16, 32):
        for _ in range(3):
            raw = g.cells(stride, 7, [6] * 4 + [2] * 3, [0, 0, -0.5, -0.5, 0, 0, 0])
            rows.append(g.rows(raw))
    every = g.node("Sigmoid", [g.node("Concat", rows, axis=1)])
    # Boxes anywhere in the picture, from a few pixels to half of it wide.
    scale = g.weight(np.array([320, 320, 160, 160, 1, 1, 1], np.float32))
    least = g.weight(np.array([0, 0, 4, 4, 0, 0, 0], np.float32))
    g.output(g.node("Add", [g.node("Mul", [every, scale]), least]), [1, 3 * 2100, 7], "output0")

    def decode(out):
        row = out[0][0].astype(np.float64)
        return scored(about(row[:, :2], row[:, 2:4]), row[:, 4:5] * row[:, 5:])

    return g.model({"family": "yolov5"}), decode, UNIT


def yolov8(rng, form):
    """Plain, segmenting, end to end."""
    g, rows = Graph(320, rng), []
    coefficients = 8 if form == "seg" else 0
    channels = 6 + coefficients
    for stride in (8, 16, 32):
        # Scores far from 0 and 1, where many are the same to the last bits.
        spread, bias = [6] * 4 + [2] * 2 + [6] * coefficients, [0, 0, -0.5, -0.5, -1, -1] + [0] * coefficients
        rows.append(g.rows(g.cells(stride, channels, spread, bias)))
    every = g.node("Concat", rows, axis=1)
    first = g.node("Slice", [every, *(g.weight(np.array([v], np.int64)) for v in (0, 6, 2))])
    first = g.node(
        "Mul", [g.node("Sigmoid", [first]), g.weight(np.array([320, 320, 160, 160, 1, 1], np.float32))]
    )
    first = g.node("Add", [first, g.weight(np.array([0, 0, 4, 4, 0, 0], np.float32))])
    if form == "seg":
        last = g.node("Slice", [every, *(g.weight(np.array([v], np.int64)) for v in (6, channels, 2))])
        whole = g.node("Concat", [first, last], axis=2)
        g.output(g.node("Transpose", [whole], perm=[0, 2, 1]), [1, channels, 2100], "output0")
        g.output(g.cells(4, coefficients, 3.0, 0.0), [1, coefficients, 80, 80], "output1")
    elif form == "end2end":
        # The surest 300 cells, corners instead of middle and size.
        def part(low, high):
            return g.node("Slice", [first, *(g.weight(np.array([v], np.int64)) for v in (low, high, 2))])

        half = g.node("Mul", [part(2, 4), g.weight(np.array([0.5], np.float32))])
        low, high = g.node("Sub", [part(0, 2), half]), g.node("Add", [part(0, 2), half])
        scores = part(4, 6)
        score = g.node("ReduceMax", [scores], axes=[2], keepdims=1)
        label = g.node("Cast", [g.node("ArgMax", [scores], axis=2, keepdims=1)], to=TensorProto.FLOAT)
        joined = g.node("Concat", [low, high, score, label], axis=2)
        flat = g.node("Reshape", [score, g.weight(np.array([-1], np.int64))])
        g.nodes.append(helper.make_node("TopK", [flat, g.weight(np.array([300], np.int64))], ["top", "at"]))
        g.output(g.node("Gather", [joined, "at"], axis=1), [1, 300, 6], "output0")
    else:
        g.output(g.node("Transpose", [first], perm=[0, 2, 1]), [1, 6, 2100], "output0")

    def decode(out):
        if form == "end2end":
            return out[0][0].astype(np.float64)
        row = out[0][0].T.astype(np.float64)
        found = scored(about(row[:, :2], row[:, 2:4]), row[:, 4:6])
        if form != "seg":
            return found

        def mask(index):
            logits = np.einsum("k,khw->hw", row[index, 6:], out[1][0].astype(np.float64))
            return cv2.resize(logits, (320, 320), interpolation=cv2.INTER_LINEAR) > 0

        return found, mask

    task = "segment" if form == "seg" else "detect"
    return g.model({"task": task, "names": "{0: 'fire', 1: 'smoke'}"}), decode, UNIT


def yolox(rng, form):
    g, rows = Graph(416, rng), []
    for stride in (8, 16, 32):
        # Averages run to 255 here.
        rows.append(g.rows(g.cells(stride, 7, 0.012, [0, 0, 0.5, 0.5, -0.2, -0.2, -0.2])))
    every = g.node("Concat", rows, axis=1)

    def part(low, high):
        return g.node("Slice", [every, *(g.weight(np.array([v], np.int64)) for v in (low, high, 2))])

    cells = grid(416, (8, 16, 32))
    if form == "raw":
        g.output(every, [1, 3549, 7], "output")
    else:
        boxes, scores = part(0, 4), g.node("Sigmoid", [part(4, 7)])
        if form == "decoded":
            stride = g.weight(cells[None, :, 2:].astype(np.float32))
            middle = g.node("Add", [part(0, 2), g.weight(cells[None, :, :2].astype(np.float32))])
            size = g.node("Exp", [part(2, 4)])
            both = g.node("Concat", [middle, size], axis=2)
            boxes = g.node("Mul", [both, stride])
        g.output(g.node("Concat", [boxes, scores], axis=2), [1, 3549, 7], "output")

    def decode(out):
        row = out[0][0].astype(np.float64)
        scores = sigmoid(row[:, 4:]) if form == "raw" else row[:, 4:]
        if form == "decoded":
            boxes = about(row[:, :2], row[:, 2:4])
        else:
            boxes = about((row[:, :2] + cells[:, :2]) * cells[:, 2:], np.exp(row[:, 2:4]) * cells[:, 2:])
        return scored(boxes, scores[:, :1] * scores[:, 1:])

    return g.model({"family": "yolox"}), decode, (np.zeros(3), np.ones(3), False)


def yolo_nas(rng, form):
    g, rows = Graph(320, rng), []
    for stride in (8, 16, 32):
        rows.append(g.rows(g.cells(stride, 6, [6] * 4 + [2] * 2, [0, 0, -0.5, -0.5, -1, -1])))
    every = g.node("Sigmoid", [g.node("Concat", rows, axis=1)])

    def part(low, high):
        return g.node("Slice", [every, *(g.weight(np.array([v], np.int64)) for v in (low, high, 2))])

    low = g.node("Mul", [part(0, 2), g.weight(np.array([200], np.float32))])
    size = g.node("Mul", [part(2, 4), g.weight(np.array([120], np.float32))])
    size = g.node("Add", [size, g.weight(np.array([4], np.float32))])
    high = g.node("Add", [low, size])
    both = [
        (g.node("Concat", [low, high], axis=2), [1, 2100, 4], "first"),
        (part(4, 6), [1, 2100, 2], "second"),
    ]
    for tensor, shape, name in both if form == "boxes first" else both[::-1]:
        g.output(tensor, shape, name)

    def decode(out):
        boxes, scores = out if form == "boxes first" else out[::-1]
        return scored(boxes[0].astype(np.float64), scores[0])

    return g.model({"family": "yolo-nas"}), decode, UNIT


def darknet(rng, form):
    family, decoded = form
    g = Graph(416, rng)
    levels = ANCHORS[family]
    maps = {s: g.cells(s, 21, 4.0, [0, 0, 0, 0, -1, 0, 0] * 3) for s in levels}
    if decoded:
        rows = [g.node("Sigmoid", [g.rows(maps[s])]) for s in levels]
        count = sum((416 // s) ** 2 for s in levels)
        every = g.node("Concat", rows, axis=1)

        def part(low, high):
            return g.node("Slice", [every, *(g.weight(np.array([v], np.int64)) for v in (low, high, 2))])

        low = g.node("Mul", [part(0, 2), g.weight(np.array([0.7], np.float32))])
        high = g.node("Add", [low, g.node("Mul", [part(2, 4), g.weight(np.array([0.3], np.float32))])])
        corners = g.node("Concat", [low, high], axis=2)
        shape = g.weight(np.array([1, count, 1, 4], np.int64))
        g.output(g.node("Reshape", [corners, shape]), [1, count, 1, 4], "boxes")
        g.output(part(5, 7), [1, count, 2], "confs")
    else:
        for stride in sorted(levels, reverse=True):
            n = 416 // stride
            g.output(maps[stride], [1, 21, n, n], f"map{stride}")

    def decode(out):
        if decoded:
            return scored(out[0][0, :, 0].astype(np.float64) * 416, out[1][0])
        found = []
        for stride, level in zip(sorted(levels, reverse=True), out):
            n, grown = 416 // stride, GROWN.get(family, {}).get(stride, 1.0)
            raw = level[0].astype(np.float64).reshape(3, 7, n * n)
            row, column = np.divmod(np.arange(n * n), n)
            for anchor, (tx, ty, tw, th, seen, *classes) in zip(levels[stride], raw):
                middle = [
                    (sigmoid(t) * grown - (grown - 1) / 2 + k) * stride for t, k in ((tx, column), (ty, row))
                ]
                size = [np.exp(t) * length for t, length in zip((tw, th), anchor)]
                scores = sigmoid(np.array(classes)).T * sigmoid(seen)[:, None]
                found.append(scored(about(np.stack(middle, 1), np.stack(size, 1)), scores))
        return np.concatenate(found)

    return g.model({"family": family}), decode, UNIT


MODELS = {
    "nanodet-a": (nanodet, "a"),
    "nanodet-b": (nanodet, "b"),
    "nanodet-plus": (nanodet_plus, None),
    "yolov5": (yolov5, None),
    "yolov8": (yolov8, "plain"),
    "yolov8-end2end": (yolov8, "end2end"),
    "yolov8-seg": (yolov8, "seg"),
    "yolox-raw": (yolox, "raw"),
    "yolox-raw-boxes": (yolox, "raw boxes"),
    "yolox-decoded": (yolox, "decoded"),
    "yolo-nas": (yolo_nas, "boxes first"),
    "yolo-nas-scores-first": (yolo_nas, "scores first"),
    "yolov3": (darknet, ("yolov3", False)),
    "yolov3-tiny": (darknet, ("yolov3-tiny", False)),
    "yolov4": (darknet, ("yolov4", False)),
    "yolov4-tiny": (darknet, ("yolov4-tiny", False)),
    "yolov4-tiny-decoded": (darknet, ("yolov4-tiny", True)),
}


def picture(rng, side=416):
    """Smooth blotches of colour, as large as cells and larger."""
    small = rng.integers(0, 256, (13, 13, 3), np.uint8)
    fine = rng.integers(0, 256, (52, 52, 3), np.uint8)
    mixed = cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC) * 0.6
    return np.clip(
        mixed + cv2.resize(fine, (side, side), interpolation=cv2.INTER_NEAREST) * 0.4, 0, 255
    ).astype(np.uint8)


def tensor(bgr, normalisation):
    mean, std, red_first = normalisation
    pixels = bgr[..., ::-1] if red_first else bgr
    # As in a frame of 32-bit floats.
    scaled = (pixels.astype(np.float32) - mean.astype(np.float32)) / std.astype(np.float32)
    return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    image = picture(np.random.default_rng(args.seed))
    truth = {}
    for number, (name, (make, form)) in enumerate(MODELS.items()):
        model, decode, normalisation = make(np.random.default_rng([args.seed, number]), form)
        if "task" not in {entry.key for entry in model.metadata_props}:
            entry = model.metadata_props.add()
            entry.key, entry.value = "names", json.dumps(NAMES)
        onnx.save(model, args.folder / f"{name}.onnx")
        side = model.graph.input[0].type.tensor_type.shape.dim[2].dim_value
        # Cut out, not scaled: the model must see the same pixels from both.
        seen = image[:side, :side]
        cv2.imwrite(str(args.folder / f"{side}.png"), seen)
        found = decode(
            ReferenceEvaluator(model).run(None, {model.graph.input[0].name: tensor(seen, normalisation)})
        )
        rows, mask = found if isinstance(found, tuple) else (found, None)
        # From edges at whole numbers to centres, within the picture.
        rows[:, :4] = np.clip(rows[:, :4] - 0.5, 0, side - 1)
        threshold, kept = suppressed(rows)
        truth[name] = {"picture": f"{side}.png", "threshold": threshold, "boxes": rows[kept].tolist()}
        if mask:
            truth[name]["masks"] = [covered(mask(index), rows[index]) for index in kept]
    (args.folder / "truth.json").write_text(json.dumps(truth))
    make, form = MODELS["yolov8-seg"]
    model, decode, normalisation = make(
        np.random.default_rng([args.seed, list(MODELS).index("yolov8-seg")]), form
    )
    write_set(args.folder / "set", np.random.default_rng([args.seed, 99]), model, decode, normalisation)
    print(json.dumps({name: len(model["boxes"]) for name, model in truth.items()}))


def write_set(folder, rng, model, decode, normalisation, pictures=12, side=320):
    for part in ("images", "labels"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    run = ReferenceEvaluator(model)
    for number in range(pictures):
        image = picture(rng, side)
        cv2.imwrite(str(folder / f"images/{number:03}.png"), image)
        rows, _ = decode(run.run(None, {"images": tensor(image, normalisation)}))
        rows[:, :4] = np.clip(rows[:, :4], 0, side)
        _, kept = suppressed(rows)
        lines = [outline(rows[index], rng, side) for index in kept if rng.random() < 0.4]
        (folder / f"labels/{number:03}.txt").write_text("".join(lines))


def outline(row, rng, side):
    """An ellipse of twelve corners about a box whose edges were moved by up to a tenth."""
    width, height = row[2] - row[0], row[3] - row[1]
    left, top, right, bottom = row[:4] + rng.uniform(-0.1, 0.1, 4) * [width, height, width, height]
    angle = np.arange(12) * np.pi / 6
    x = np.clip((left + right + (right - left) * np.cos(angle)) / 2, 0, side) / side
    y = np.clip((top + bottom + (bottom - top) * np.sin(angle)) / 2, 0, side) / side
    return f"{int(row[5])} " + " ".join(f"{v:.6f}" for v in np.stack([x, y], 1).ravel()) + "\n"


def covered(mask, row):
    """Pixels of a mask that the box holds, each as row * width + column."""
    inside = np.zeros_like(mask)
    left, top = np.ceil(row[:2]).astype(int)
    right, bottom = np.floor(row[2:4]).astype(int) + 1
    inside[top:bottom, left:right] = True
    return np.flatnonzero(mask & inside).tolist()


if __name__ == "__main__":
    main()
