"""The segment stage with tiny models, through the command line."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sc3d.cli import main

pytest_plugins = "tests.segmentation.tiny_sam3"
NAMES = {1: "building", 3: "road"}


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "images").mkdir()
    for row in range(3):
        Image.fromarray(np.random.default_rng(row).integers(0, 256, (96, 128, 3)).astype(np.uint8)).save(
            tmp_path / "images" / f"photo_{row}.png"
        )
    (tmp_path / "classes.json").write_text(
        json.dumps([{"id": label, "name": name, "color": [label, 2, 3]} for label, name in NAMES.items()])
    )
    return tmp_path


def arguments(scene, models, backend="grounded-sam", *more) -> list[str]:
    return [
        "segment",
        str(scene),
        "--backend",
        backend,
        "--model-dir",
        str(models),
        "--detector",
        "any/dino",
        "--segmenter",
        "any/sam2",
        "--concept-model",
        "any/sam3_video",
        "--box-threshold",
        "0.0",
        "--text-threshold",
        "0.0",
        "--tile",
        "96",
        "--device",
        "cpu",
        *more,
    ]


def files(scene) -> dict[str, bytes]:
    return {
        str(file.relative_to(scene)): file.read_bytes()
        for folder in ("masks", "confidence", "instances")
        for file in (scene / folder).iterdir()
    }


@pytest.mark.parametrize("backend", ["grounded-sam", "sam3"])
def test_prompts_to_masks_confidence_and_instances_and_never_over_other_masks(scene, models, backend, capsys):
    coco = pytest.importorskip("pycocotools.coco")
    main(arguments(scene, models, backend))
    num_instances = 0
    for row in range(3):
        mask, confidence = (
            np.array(Image.open(scene / folder / f"photo_{row}.png")) for folder in ("masks", "confidence")
        )
        assert (
            mask.shape == confidence.shape == (96, 128)
            and mask.any()
            and set(np.unique(mask)) <= {0, 1, 3}
            and (confidence > 0).all()
        )
        found = coco.COCO(str(scene / "instances" / f"photo_{row}.json"))
        assert (
            found.loadImgs(1)[0]["file_name"] == f"photo_{row}.png"
            and {label: entry["name"] for label, entry in found.cats.items()} == NAMES
        )
        covered = np.zeros((96, 128), bool)
        for instance in found.anns.values():
            assert instance["prompt"] == instance["name"] == NAMES[instance["category_id"]]
            assert instance["score"] == pytest.approx(
                instance["box_score"] * min(1, instance["mask_score"]), abs=1e-5
            )
            covered |= found.annToMask(instance) > 0
        # SAM 3 labels areas beside instances
        assert (mask[covered] > 0).all() and (backend == "sam3" or not mask[~covered].any())
        num_instances += len(found.anns)
    summary = json.loads((scene / "masks.json").read_text())["summary"]
    assert (summary["segmented"], summary["already_there"], summary["instances"]) == (
        3,
        0,
        num_instances,
    ) and num_instances > 0
    assert not (scene / "segment.unfinished.json").exists()
    before = {
        name: (scene / "masks" / name).read_bytes() for name in ("photo_0.png", "photo_1.png", "photo_2.png")
    }
    main(arguments(scene, models, backend, "--prompts", "road=street,parking lot"))
    # nobody's work is lost
    assert {file.name: file.read_bytes() for file in (scene / "masks.before").iterdir()} == before
    assert len(list((scene / "masks").iterdir())) == len(list((scene / "instances").iterdir())) == 3


KILLED = """
import os, signal, sys
from sc3d.cli import main
replace = os.replace
def kill(source, target):
    if str(target).endswith("masks/photo_1.png"):
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)
os.replace = kill
main(sys.argv[1:])
"""


def test_a_killed_run_goes_on_with_the_missing_photos(scene, models, monkeypatch):
    """Killed (SIGKILL) at the worst moment, when the second mask is written but has no name yet; goes on with
    other models' folder and device.
    """
    from sc3d.segmentation.grounded_sam import GroundedSam

    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, *arguments(scene, models)], env=environment, capture_output=True
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    names = {file.name for file in (scene / "masks").iterdir()}
    # and a temporary file
    assert len(names) == 2 and "photo_0.png" in names and not (scene / "masks.json").exists()
    first, seen, segment = (scene / "masks" / "photo_0.png").stat().st_mtime_ns, [], GroundedSam.segment
    monkeypatch.setattr(
        GroundedSam, "segment", lambda self, image: seen.append(int(image[0, 0, 0])) or segment(self, image)
    )
    main([*arguments(scene, models), "--device", "auto"])
    assert seen == [
        int(np.array(Image.open(scene / "images" / f"photo_{row}.png"))[0, 0, 0]) for row in (1, 2)
    ]
    summary = json.loads((scene / "masks.json").read_text())["summary"]
    assert (summary["segmented"], summary["already_there"]) == (2, 1) and (
        scene / "masks" / "photo_0.png"
    ).stat().st_mtime_ns == first
    assert sorted(files(scene)) == [
        f"{folder}/photo_{row}.{kind}"
        for folder, kind in (("confidence", "png"), ("instances", "json"), ("masks", "png"))
        for row in range(3)
    ]
    whole = files(scene)
    for folder in ("masks", "confidence", "instances"):
        for file in (scene / folder).iterdir():
            file.unlink()
        (scene / folder).rmdir()
    main([*arguments(scene, models), "--overwrite"])
    assert files(scene) == whole


def test_half_precision_without_a_gpu_is_refused(scene, models, capsys):
    for backend in ("grounded-sam", "sam3"):
        with pytest.raises(SystemExit) as stopped:
            main(arguments(scene, models, backend, "--half"))
        assert (
            stopped.value.code == 2
            and "half precision is for CUDA GPUs" in capsys.readouterr().err
            and not (scene / "masks").exists()
        )


def test_folder_of_masks_and_errors(scene, tmp_path, capsys):
    given = tmp_path / "given"
    given.mkdir()
    Image.fromarray(np.full((48, 64), 3, np.uint8)).save(given / "photo_1.png")
    main(["segment", str(scene), "--masks", str(given)])
    assert np.array(Image.open(scene / "masks" / "photo_1.png")).max() == 3
    Image.fromarray(np.full((48, 64), 2, np.uint8)).save(given / "photo_0.png")
    with pytest.raises(SystemExit) as stopped:
        main(["segment", str(scene), "--masks", str(given)])
    assert stopped.value.code == 2 and "class id 2" in capsys.readouterr().err
    assert not (scene / "masks" / "photo_0.png").exists()


def test_missing_weights_and_bad_prompts_are_said(scene, capsys):
    for options, word in (
        (["--backend", "grounded-sam", "--model-dir", str(scene)], "grounding-dino"),
        (["--backend", "sam3", "--model-dir", str(scene)], "SAM license"),
        (["--backend", "sam3", "--overlap", "0"], "overlap"),
        (["--backend", "grounded-sam", "--prompts", "street"], "NAME=text"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["segment", str(scene), *options])
        assert stopped.value.code == 2 and word in capsys.readouterr().err
        assert not (scene / "masks").exists()
