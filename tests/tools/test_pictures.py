"""The manual's pictures are those that `tools/make_pictures.py` makes, small, and shown."""

import re

import numpy as np
import pytest
from PIL import Image

from tools import make_pictures
from tools.make_pictures import FAULTS, MANUAL, PICTURES, edited, names, only, other_ids, shifted


def test_every_picture_is_made_small_and_shown():
    files = list(PICTURES.iterdir())
    assert {file.name for file in files} == {f"{name}.jpg" for name in names()}
    assert max(file.stat().st_size for file in files) < 300_000
    shown = {
        name
        for page in ("why-is-my-result-bad.md", "examples/README.md")
        for name in re.findall(r"pictures/(\w[\w-]*)\.jpg\)", (MANUAL / page).read_text())
    }
    assert shown == set(names())


def test_ten_faults_are_numbered_and_have_cause_and_cure():
    page = (MANUAL / "why-is-my-result-bad.md").read_text()
    faults = re.split(r"^### ", page, flags=re.M)[1:]
    assert [int(fault.split(".")[0]) for fault in faults] == list(range(1, 11)) and len(FAULTS) == 10
    assert all("**Cause**" in fault and "**Cure**" in fault for fault in faults)


def test_what_is_done_to_photos_and_masks(tmp_path):
    (tmp_path / "given").mkdir()
    for number in range(3):
        Image.fromarray(np.full((4, 8), number, np.uint8)).save(tmp_path / "given" / f"{number}.png")
    kept = edited(tmp_path / "given", tmp_path / "kept", only(0, 2), {"0", "1", "2"})
    assert sorted(path.name for path in kept.iterdir()) == ["0.png", "2.png"]
    again = edited(tmp_path / "given", tmp_path / "again", other_ids, {"1", "2"})
    assert [np.unique(np.asarray(Image.open(path))).tolist() for path in sorted(again.iterdir())] == [
        [4],
        [1],
    ]
    row = np.arange(16)[None]
    assert (
        shifted(row, 0)[0, 2] == 0 and (make_pictures.moved(np.full((3, 30, 3), 7, np.uint8), 0) == 7).all()
    )


def test_unknown_pictures_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["make_pictures.py", "nothing"])
    with pytest.raises(SystemExit):
        make_pictures.main()
    assert "no picture is called nothing" in capsys.readouterr().err
