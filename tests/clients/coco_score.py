"""A detector's findings, scored by pycocotools.

    coco_score.py TRUTH.json FOUND.json

prints, per category and for its boxes (and masks, where truth has them), average precision at IoU 0.5 and over
0.5 to 0.95, for all sizes, small, medium and large; null where there is nothing to be found.
"""

import argparse
import contextlib
import io
import json
from pathlib import Path

from pycocotools import mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

AREAS = ("all", "small", "medium", "large")


def packed(entries, sizes):
    """Runs of pixels as pycocotools packs them."""
    for entry in entries:
        if "segmentation" in entry:
            height, width = sizes[entry["image_id"]]
            entry["segmentation"] = mask.frPyObjects(entry["segmentation"], height, width)
    return entries


def scores(truth, found, category, kind):
    run = COCOeval(truth, found, kind)
    run.params.catIds = [category]
    run.evaluate()
    run.accumulate()
    # Overlaps, recalls, categories, areas, counts a picture.
    precision = run.eval["precision"][:, :, 0, :, -1]

    def mean(part):
        return None if (part < 0).all() else float(part[part > -1].mean())

    return {
        area: {"ap50": mean(precision[0, :, k]), "ap50_95": mean(precision[:, :, k])}
        for k, area in enumerate(AREAS)
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("truth", type=Path)
    parser.add_argument("found", type=Path)
    args = parser.parse_args()
    facts = json.loads(args.truth.read_text())
    sizes = {image["id"]: (image["height"], image["width"]) for image in facts["images"]}
    packed(facts["annotations"], sizes)
    results = packed(json.loads(args.found.read_text()), sizes)
    kinds = {"box": ("bbox", lambda entry: entry["bbox"][2] * entry["bbox"][3])}
    if any("segmentation" in entry for entry in facts["annotations"]):
        kinds["mask"] = ("segm", lambda entry: float(mask.area(entry["segmentation"])))
    with contextlib.redirect_stdout(io.StringIO()):
        said = {category["name"]: {} for category in facts["categories"]}
        for name, (kind, area) in kinds.items():
            truth = COCO()
            truth.dataset = facts | {"annotations": [e | {"area": area(e)} for e in facts["annotations"]]}
            truth.createIndex()
            other = "segmentation" if kind == "bbox" else "bbox"
            found = truth.loadRes([{k: v for k, v in entry.items() if k != other} for entry in results])
            for category in facts["categories"]:
                said[category["name"]][name] = scores(truth, found, category["id"], kind)
    print(json.dumps(said))


if __name__ == "__main__":
    main()
