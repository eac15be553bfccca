"""The segment stage with tiny models, through the command line."""

import json

import numpy as np
import pytest
from PIL import Image

from sc3d.cli import main


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "images").mkdir()
    for row in range(2):
        Image.fromarray(np.random.default_rng(row).integers(0, 256, (96, 128, 3)).astype(np.uint8)).save(tmp_path / "images" / f"photo_{row}.png")
    (tmp_path / "classes.json").write_text(json.dumps([{"id": 1, "name": "building", "color": [1, 2, 3]}, {"id": 3, "name": "road", "color": [4, 5, 6]}]))
    return tmp_path


def segment(scene, models, *more) -> None:
    main(["segment", str(scene), "--backend", "grounded-sam", "--model-dir", str(models), "--detector", "any/dino", "--segmenter", "any/sam2",
          "--box-threshold", "0.0", "--text-threshold", "0.0", "--device", "cpu", *more])


def test_prompts_to_masks_resumed_and_never_over_other_masks(scene, tiny_models, capsys):
    segment(scene, tiny_models)
    for row in range(2):
        mask = np.array(Image.open(scene / "masks" / f"photo_{row}.png"))
        assert mask.shape == (96, 128) and set(np.unique(mask)) <= {0, 1, 3}
        assert (scene / "confidence" / f"photo_{row}.png").exists()
    assert json.loads((scene / "masks.json").read_text())["summary"]["segmented"] == 2
    assert not (scene / "segment.unfinished.json").exists()
    with pytest.raises(SystemExit) as stopped:
        segment(scene, tiny_models, "--prompts", "road=street,parking lot")
    assert stopped.value.code == 2 and "remove the folder" in capsys.readouterr().err


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
    for arguments, word in ((["--model-dir", str(scene)], "grounding-dino"), (["--prompts", "street"], "NAME=text")):
        with pytest.raises(SystemExit) as stopped:
            main(["segment", str(scene), "--backend", "grounded-sam", *arguments])
        assert stopped.value.code == 2 and word in capsys.readouterr().err
        assert not (scene / "masks").exists()
