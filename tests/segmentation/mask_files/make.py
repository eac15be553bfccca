"""Makes the files beside it with each format's own library, and with it what that library draws: read by
test_mask_imports.py.

Run once, by hand, in an environment of its own: pip install labelme==6.3.1 datumaro==1.13.12 cvat-sdk==2.80.0
pycocotools==2.0.11, then python tests/mask_files/make.py. The files are committed so that the tests need none
of these packages.
"""

import json
import math
import shutil
from pathlib import Path

import cv2
import datumaro as dm
import numpy as np
from cvat_sdk import masks as cvat_masks
from datumaro.components.annotation import RotatedBbox
from datumaro.components.media import Image as Media
from labelme import utils as labelme_utils
from labelme._label_file import LabelFile
from PIL import Image
from pycocotools import mask as coco_masks
from pycocotools.coco import COCO

HERE = Path(__file__).parent
WIDTH, HEIGHT = 96, 72
CLASSES = {"building": 1, "road": 2, "tree": 3}
NAMES = list(CLASSES)
PHOTOS = ("DJI_0001", "DJI_0002")


def blob(seed: int) -> np.ndarray:
    """(H, W) bool: islands and holes."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((HEIGHT, WIDTH)), (0, 0), 5)
    return noise > np.quantile(noise, 0.75)


def write(name: str, photo: str, labels: np.ndarray) -> None:
    folder = HERE / "expected" / name
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(labels.astype(np.uint8)).save(folder / f"{photo}.png")


def make_labelme() -> None:
    folder = HERE / "labelme"
    folder.mkdir()
    mask = blob(1)[20:50, 10:60]
    plain = [
        ("road", "polygon", [[3.2, 5.7], [90.4, 8.1], [85.0, 40.3], [50.5, 20.2], [8.8, 60.1]]),
        ("building", "rectangle", [[70.5, 60.2], [40.1, 30.4]]),
        ("tree", "circle", [[30.3, 40.6], [38.1, 47.2]]),
        ("building", "oriented_rectangle", [[60.0, 5.0], [80.0, 15.0], [75.0, 25.0], [55.0, 15.0]]),
    ]
    lines = [("tree", "linestrip", [[1.0, 1.0], [90.0, 70.0]]), ("road", "point", [[5.0, 5.0]]), ("road", "line", [[5.0, 5.0], [50.0, 5.0]])]
    for photo, chosen in zip(PHOTOS, (plain[:3], plain[1:]), strict=True):
        shapes = [{"label": label, "points": points, "group_id": None, "description": "", "shape_type": kind, "flags": {}, "mask": None}
                  for label, kind, points in [*chosen, *lines]]
        picture = labelme_utils.img_arr_to_b64(mask.astype(np.uint8))
        shapes.insert(2, {"label": "tree", "points": [[10.0, 20.0], [59.0, 49.0]], "group_id": None, "description": "", "shape_type": "mask",
                          "flags": {}, "mask": picture})
        LabelFile().save(str(folder / f"{photo}.json"), shapes, f"..\\photos\\{photo}.JPG", HEIGHT, WIDTH)
        with_area = [shape | {"mask": mask} for shape in shapes if shape["shape_type"] not in ("linestrip", "point", "line")]
        write("labelme", photo, labelme_utils.shapes_to_label((HEIGHT, WIDTH), with_area, CLASSES)[0])


def items(boxes: bool) -> list[dm.DatasetItem]:
    drawn = []
    for index, photo in enumerate(PHOTOS):
        first = 10 * index  # pycocotools finds annotations by their id
        annotations = [
            dm.Polygon([3.5, 4.25, 90.0, 8.0, 85.25, 60.5, 45.5, 30.0, 10.0, 66.0], label=1, z_order=1, id=first + 1, group=1),
            dm.Mask(blob(2 + index), label=2, z_order=0, id=first + 2, group=2),
            dm.Polygon([20.0, 10.0, 50.5, 12.5, 30.25, 50.75], label=0, z_order=2 - index, id=first + 3, group=3),
        ]
        if boxes:
            annotations += [
                dm.Bbox(5.25, 40.5, 30.5, 20.25, label=0, z_order=3, id=first + 5, group=5),
                RotatedBbox(70.0, 20.0, 30.0, 12.0, 30.0, label=2, z_order=1, id=first + 6, group=6),
                dm.PolyLine([0.0, 0.0, 95.0, 70.0], label=1, z_order=9, id=first + 7, group=7),
                dm.Points([4.0, 4.0], label=1, z_order=9, id=first + 8, group=8),
            ]
        drawn.append(dm.DatasetItem(photo, media=Media.from_numpy(np.zeros((HEIGHT, WIDTH, 3), np.uint8), ext=".JPG"), annotations=annotations))
    return drawn


def export(name: str, entries: list[dm.DatasetItem], found: str, target: Path) -> None:
    temporary = HERE / "temporary"
    dm.Dataset.from_iterable(entries, categories=NAMES).export(str(temporary), name, save_media=False)
    shutil.copyfile(next(temporary.rglob(found)), target)
    shutil.rmtree(temporary)


def make_coco() -> None:
    """Datumaro's file, with polygons and plain run-length codes; then the same with pycocotools' compressed
    codes for all regions.
    """
    export("coco_instances", items(boxes=False), "*.json", HERE / "coco.json")
    coco = COCO(HERE / "coco.json")
    content = json.loads((HERE / "coco.json").read_text())
    for annotation in content["annotations"]:
        code = coco.annToRLE(annotation)
        annotation["segmentation"] = {"size": code["size"], "counts": code["counts"].decode()}
    (HERE / "coco_compressed.json").write_text(json.dumps(content))
    for image in coco.loadImgs(coco.getImgIds()):
        regions = [(coco.annToMask(entry).astype(bool), CLASSES[coco.cats[entry["category_id"]]["name"]])
                   for entry in coco.loadAnns(coco.getAnnIds(image["id"]))]
        labels = np.zeros((HEIGHT, WIDTH), np.uint8)
        for region, class_id in sorted(regions, key=lambda entry: (-entry[0].sum(), -entry[1])):
            labels[region] = class_id
        write("coco", Path(image["file_name"]).stem, labels)


def make_cvat() -> None:
    """Datumaro's file, to which is added what it cannot write: an ellipse, and a mask in a box of its own as
    CVAT's SDK codes it.
    """
    export("cvat", items(boxes=True), "*.xml", HERE / "cvat.xml")
    region = blob(7) & (np.arange(WIDTH) > 50)
    *code, left, top, right, bottom = cvat_masks.encode_mask(region)
    added = (f'  <ellipse label="tree" source="manual" occluded="0" cx="40.50" cy="50.50" rx="25.00" ry="9.00" rotation="330.0" z_order="5">\n    </ellipse>\n'
             f'    <mask label="building" source="manual" occluded="0" rle="{str(code)[1:-1]}" left="{left}" top="{top}" width="{right - left + 1}" '
             f'height="{bottom - top + 1}" z_order="4">\n    </mask>\n')
    text = (HERE / "cvat.xml").read_text()
    (HERE / "cvat.xml").write_text(text.replace("</image>", added + "</image>", 1))

    def polygon(*points: float) -> np.ndarray:
        codes = coco_masks.frPyObjects([list(points)], HEIGHT, WIDTH)
        return coco_masks.decode(codes)[..., 0].astype(bool)

    def turned(x: float, y: float, width: float, height: float, degrees: float) -> np.ndarray:
        cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        corners = [(-width / 2, -height / 2), (width / 2, -height / 2), (width / 2, height / 2), (-width / 2, height / 2)]
        return polygon(*(value for u, v in corners for value in (x + cos * u - sin * v, y + sin * u + cos * v)))

    for index, photo in enumerate(PHOTOS):
        regions = [
            (1, 2, polygon(3.5, 4.25, 90, 8, 85.25, 60.5, 45.5, 30, 10, 66)), (0, 3, blob(2 + index)),
            (2 - index, 1, polygon(20, 10, 50.5, 12.5, 30.25, 50.75)), (3, 1, turned(20.5, 50.625, 30.5, 20.25, 0)), (1, 3, turned(70, 20, 30, 12, 30)),
        ]
        if index == 0:
            ellipse = np.zeros((HEIGHT, WIDTH), np.uint8)
            cv2.ellipse(ellipse, (40, 50), (25, 9), 330.0, 0, 360, 255, thickness=-1)
            regions += [(5, 3, ellipse > 0), (4, 1, cvat_masks.decode_mask([*code, left, top, right, bottom], image_width=WIDTH, image_height=HEIGHT))]
        labels = np.zeros((HEIGHT, WIDTH), np.uint8)
        for _, class_id, region in sorted(regions, key=lambda entry: entry[0]):
            labels[region] = class_id
        write("cvat", photo, labels)


if __name__ == "__main__":
    for path in HERE.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
    make_labelme()
    make_coco()
    make_cvat()
