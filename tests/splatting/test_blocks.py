"""Training by blocks: the cut of the plane, what a block's photos show, and the merged model against training
everything at once.
"""

import csv
import os
import shutil
import signal
import threading
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import psutil
import pycolmap
import pytest
import torch

from sc3d.cli import main
from sc3d.errors import InputError
from sc3d.geometry.blocks import split_blocks, views_of
from sc3d.geometry.cameras import rays, undistorted
from sc3d.io.json_files import read_json
from sc3d.io.splats import read_splat_ply
from sc3d.runner import sidecar
from sc3d.scene.depth_map import DepthMap, depth_file, write_depth_map
from sc3d.scene.scene import Scene
from sc3d.settings.train import Train, TrainSettings
from sc3d.splatting import blocks, dataset, device
from sc3d.splatting.blocks import BlockJob, restrict, share_settings
from sc3d.splatting.dataset import scene_data
from sc3d.splatting.trainer import Trainer
from sc3d.stages import train as train_stage

pytestmark = pytest.mark.usefixtures("one_thread")

OPTIONS = ["--iterations", "90", "--max-gaussians", "3000", "--test-every", "4", "--checkpoint-every", "20"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    main(["synthesize", str(folder), "--views", "8", "--width", "160", "--num-points", "1000"])
    return folder


def trained(site, folder, *options):
    """A scene folder of its own with the site's photos and cameras, trained."""
    folder.mkdir(exist_ok=True)
    for name in ("images", "sparse"):
        if not (folder / name).exists():
            (folder / name).symlink_to(site / name)
    main(["train", str(folder), *OPTIONS, *options])
    return folder


@pytest.fixture(scope="module")
def blocked(site, tmp_path_factory, one_thread):
    return trained(site, tmp_path_factory.mktemp("blocked"), "--blocks", "2")


def test_too_many_blocks_are_refused_before_work(site, tmp_path, capsys):
    with pytest.raises(SystemExit) as status:
        trained(site, tmp_path / "scene", "--blocks", "100000")
    assert status.value.code == 2 and "lower --blocks" in capsys.readouterr().err
    with pytest.raises(InputError):
        Train(blocks=-1)


def test_affine_colors_of_blocks_are_means(site, tmp_path, monkeypatch):
    found = []
    monkeypatch.setattr(
        train_stage, "write_training_sheet", lambda path, result, data, settings: found.append(result)
    )
    few = ["--iterations", "24", "--plain", "--no-fill", "--exposure", "affine"]
    folder = trained(site, tmp_path / "scene", *few, "--blocks", "2", "--checkpoint-every", "0")
    monkeypatch.undo()
    exposures = found[0].exposures
    assert exposures.shape == (8, 12) and not exposures[3::4].any() and np.isfinite(exposures).all()
    assert (np.abs(exposures).max(axis=1) > 0).sum() == 6 and np.abs(exposures).max() < 1
    assert read_json(sidecar(folder / "gaussians.ply"))["settings"]["exposure"] == "affine"


class Reached(Exception):
    """Training would begin."""


CPU, GPU = (1000, 200_000, 800), (7000, 1_000_000, 1600)


@pytest.mark.parametrize(
    ("gpu", "options", "numbers"),
    [
        (False, {}, CPU),
        (True, {}, GPU),
        (True, {"device": "cpu"}, CPU),
        (True, {"iterations": 50, "max_size": 48}, (50, 1_000_000, 48)),
        (False, {"blocks": 2}, CPU),
        (True, {"blocks": 2}, GPU),
        (False, {"blocks": 2, "cluster": "tls://nowhere:1"}, CPU),
        (False, {"blocks": 2, "cluster": "tls://nowhere:1", "device": "cuda"}, GPU),
    ],
)
def test_numbers_are_those_of_the_device_that_trains(site, tmp_path, monkeypatch, gpu, options, numbers):
    found, sizes = [], []

    def begun(*arguments):
        found.extend(each for each in arguments if isinstance(each, TrainSettings))
        found.extend(each.settings for each in arguments if isinstance(each, BlockJob))
        raise Reached

    def sized(view, max_size):
        sizes.append(max_size)
        return undistorted(view, max_size)

    pretend_gpu(monkeypatch, gpu)
    monkeypatch.setattr(train_stage, "train", begun)
    monkeypatch.setattr(train_stage, "train_blocks", begun)
    monkeypatch.setattr(train_stage, "open_executor", lambda settings: nullcontext())
    monkeypatch.setattr(dataset, "undistorted", sized)
    for name in ("images", "sparse"):
        (tmp_path / name).symlink_to(site / name)
    with pytest.raises(Reached):
        train_stage.run(Scene(tmp_path), Train(**options))
    (settings,) = found
    assert (settings.iterations, settings.max_gaussians, settings.max_size) == numbers
    assert set(sizes) == {min(160, settings.max_size)}
    assert settings.device == options.get("device", "auto")  # each worker looks for its own


def pretend_gpu(monkeypatch, there):
    precision = torch.backends.cudnn.allow_tf32
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", precision)  # set back afterwards
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: name)


def test_the_names_of_checkpoints_are_those_of_the_numbers(site):
    """So that a run that was interrupted goes on, whether its numbers were given or stand for themselves."""
    scene, auto = Scene(site), Train()
    for kind, other in (("cpu", "cuda"), ("cuda", "cpu")):
        training = auto.training.resolved(kind)
        given = Train(max_gaussians=training.max_gaussians, max_size=training.max_size)
        name = train_stage._unfinished(scene, auto, training).name
        assert name == train_stage._unfinished(scene, given, given.training.resolved(other)).name
        assert name != train_stage._unfinished(scene, auto, auto.training.resolved(other)).name


def test_blocks_share_the_numbers_of_the_device(site, monkeypatch):
    data, _ = scene_data(Scene(site), Train())
    block = split_blocks(data.points, 2)[0]
    views = views_of(block, data.points, data.sightings)
    for there, (steps, count, size) in ((False, CPU), (True, GPU)):
        pretend_gpu(monkeypatch, there)
        found = share_settings(Train().training, data, block, views)
        assert found.iterations == round(steps * len(views) / 8) and found.max_size == size
        assert found.max_gaussians == round(count * block.holds(data.points, border=True).mean())


def test_masks_show_core_and_border_as_the_exact_depth_does(site):
    scene = Scene(site)
    data, origin = scene_data(scene, Train())
    agreed, shown = [], []
    for block in split_blocks(data.points, 3):
        views = views_of(block, data.points, data.sightings)
        part = restrict(data, block, views)
        assert len(part.points) == block.holds(data.points, border=True).sum() and len(views) >= 2
        for row, (view, track) in enumerate(zip(part.views, part.tracks, strict=True)):
            np.testing.assert_array_equal(
                part.points[track],
                data.points[data.tracks[views[row]]][
                    block.holds(data.points, border=True)[data.tracks[views[row]]]
                ],
            )
            directions, along = rays(view)
            depth = np.load(site / "truth_depth" / f"{Path(view.name).stem}.npy").ravel()
            known = depth > 0
            surface = view.center + directions * (depth / along)[:, None]
            truth = block.holds(surface, border=True)
            agreed.append((part.mask(row).ravel() == truth)[known].mean())
            shown.append(truth[known].mean())
    assert np.mean(agreed) > 0.95 and min(agreed) > 0.85, (np.mean(agreed), min(agreed))
    assert min(shown) < 0.7  # there was something to tell apart


def test_pixels_outside_the_mask_leave_no_trace(site):
    """The loss of a block must not depend on what the photos show elsewhere."""
    data, _ = scene_data(Scene(site), Train())
    block = split_blocks(data.points, 2)[0]
    views = views_of(block, data.points, data.sightings)
    part = restrict(data, block, views)
    settings = share_settings(
        Train(iterations=40, max_gaussians=1500, surface_from=1.0, coarse_until=0.0, fill=False).training,
        data,
        block,
        views,
    )
    noise = np.random.default_rng(0)

    def spoiled(row):
        image = part.image(row).copy()
        # SSIM looks 5 px around, twice
        inner = (
            torch.nn.functional.max_pool2d(torch.from_numpy(part.mask(row))[None, None].float(), 31, 1, 15)[
                0, 0
            ].numpy()
            > 0
        )
        image[~inner] = noise.integers(0, 256, (int((~inner).sum()), 3))
        return image

    other = type(part)(part.views, spoiled, part.points, part.colors, part.tracks, part.masks)
    results = []
    for source in (part, other):
        trainer = Trainer(source, settings)
        for _ in range(8):
            trainer.step()
        results.append(trainer.gaussians.detached())
    for name, tensor in results[0].parameters().items():
        assert torch.equal(tensor, results[1].parameters()[name]), name


def test_merged_blocks_are_as_good_as_the_whole_and_have_no_seam(site, blocked, tmp_path):
    whole = trained(site, tmp_path / "whole")
    summaries = [read_json(sidecar(folder / "gaussians.ply"))["summary"] for folder in (whole, blocked)]
    assert summaries[1]["held_out_psnr"] > summaries[0]["held_out_psnr"] - 0.4
    data, _ = scene_data(Scene(site), Train())
    low, high = split_blocks(data.points, 2)
    axis = int(np.nonzero(np.isfinite(low.high))[0][0])
    width, counts = max(low.border[axis], high.border[axis]), []
    for folder in (whole, blocked):
        places = read_splat_ply(folder / "gaussians.ply")[0]["means"][:, low.axes[axis]]
        counts.append([(np.abs(places - low.high[axis]) < width).sum(), len(places)])
    seam = np.array(counts)
    assert 0.8 < seam[1, 0] / seam[0, 0] < 1.25, seam  # twice as many if both blocks kept theirs
    assert sum(summaries[1]["block_gaussians"]) > seam[1, 1] + 0.5 * seam[1, 0]  # which they had
    assert (blocked / "train.csv").read_text().splitlines()[0].startswith("block,iteration,") and (
        blocked / "train.jpg"
    ).exists()
    assert not list(blocked.glob("train.*.blocks"))


def test_two_workers_of_which_one_is_killed_give_the_same_bytes(site, blocked, tmp_path):
    killed = []

    def kill():
        while not killed:
            if list((tmp_path / "scene").glob("train.*.blocks/*.checkpoint")):
                workers = [
                    child
                    for child in psutil.Process().children(recursive=True)
                    if "spawn_main" in " ".join(child.cmdline())
                ]
                os.kill(workers[0].pid, signal.SIGKILL)
                killed.append(workers[0].pid)
            time.sleep(0.01)

    (tmp_path / "scene").mkdir()
    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    folder = trained(site, tmp_path / "scene", "--blocks", "2", "--workers", "2")
    assert killed and (folder / "gaussians.ply").read_bytes() == (blocked / "gaussians.ply").read_bytes()


def test_an_interrupted_run_goes_on_where_it_was(site, blocked, tmp_path, monkeypatch):
    step, begun = Trainer.step, []

    def dying(self):
        if self.iteration == 30 and begun:
            raise KeyboardInterrupt
        row = step(self)
        begun.extend([1] if self.iteration == self.settings.iterations else [])
        return row

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", dying)
        with pytest.raises(SystemExit):
            trained(site, tmp_path / "scene", "--blocks", "2")
    (left,) = (tmp_path / "scene").glob("train.*.blocks")
    assert {file.name for file in left.iterdir()} == {"0.ply", "0.json", "1.checkpoint"}
    seen = []
    monkeypatch.setattr(
        Trainer,
        "resume",
        lambda self, path, resume=Trainer.resume: (
            resume(self, path),
            seen.append((path.name, self.iteration)),
        ),
    )
    monkeypatch.setattr(
        blocks,
        "restrict",
        lambda data, block, views, seen_by, known=restrict: (
            seen.append(block),
            known(data, block, views, seen_by),
        )[1],
    )
    folder = trained(site, tmp_path / "scene", "--blocks", "2")
    assert len(seen) == 2 and seen[1] == ("1.checkpoint", 20)  # block 0 was not trained again
    assert (folder / "gaussians.ply").read_bytes() == (blocked / "gaussians.ply").read_bytes()


def hold_out(folder, *options):
    few = ["--iterations", "8", "--max-gaussians", "500", "--max-size", "64", "--no-fill", "--overwrite"]
    main(["train", str(folder), *few, *options])
    return read_json(sidecar(folder / "gaussians.ply"))["summary"]


def scene_of(site, folder):
    for name in ("images", "sparse"):
        shutil.copytree(site / name, folder / name)
    return folder


def test_a_sector_is_held_out_of_all_blocks_and_listed(site, tmp_path, caplog):
    folder = scene_of(site, tmp_path)
    options = ["--test-every", "4", "--test-sector", "0.25"]
    listed = []
    with caplog.at_level("INFO"):
        for blocks in ([], ["--blocks", "2"]):
            summary = hold_out(folder, *options, *blocks)
            assert summary["held_out_photos"] == 1 and summary["held_out_sector_photos"] == 2
            assert 0 < summary["held_out_sector_seen"] <= 1 and "held_out_sector_seen_psnr" in summary
            with (folder / "held_out.csv").open(newline="") as file:
                listed.append([(row["photo"], row["held_out"], row["seen"]) for row in csv.DictReader(file)])
    assert listed[0] == listed[1] and [kind for _, kind, _ in listed[0]] == ["every 4", "sector", "sector"]
    assert "2 of 8 photos are held out as a sector: " in caplog.text
    assert "sparse points are not used: fewer than 2 photos" in caplog.text
    assert not any(name.startswith("held_out") for name in hold_out(folder))
    assert not (folder / "held_out.csv").exists()


def test_depth_maps_that_were_made_with_the_sector_are_told(site, tmp_path, caplog):
    folder = scene_of(site, tmp_path)
    for photo in (folder / "images").iterdir():
        write_depth_map(depth_file(folder / "depth", photo.name), DepthMap.nothing((107, 160)))
    for options, told in (["--fill"], True), (["--no-fill"], False):
        caplog.clear()
        hold_out(folder, "--test-sector", "0.25", *options)
        assert ("--no-fill trains without them" in caplog.text) == told


def test_a_sector_of_a_model_without_tracks_is_refused_before_work(site, tmp_path, capsys):
    """Nobody could say what the others see."""
    folder = scene_of(site, tmp_path)
    model = folder / "sparse" / "0"
    pycolmap.Reconstruction(str(model)).write_text(str(model))
    for file in model.glob("*.bin"):
        file.unlink()
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    (model / "images.txt").write_text("".join(f"{line}\n\n" for line in lines[::2]))
    points = [
        line.split()[:8] for line in (model / "points3D.txt").read_text().splitlines() if line[0] != "#"
    ]
    (model / "points3D.txt").write_text("".join(" ".join(point) + "\n" for point in points))
    with pytest.raises(SystemExit) as status:
        hold_out(folder, "--test-sector", "0.25")
    assert status.value.code == 2 and "lower --test-sector" in capsys.readouterr().err
    assert not (folder / "gaussians.ply").exists()
