"""Help is quick; bad input gives one clear line, status 2 and no half-written output."""

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from PIL import Image

import sc3d.stages.label  # noqa: F401 - loaded before a test gives up its rights
from sc3d.cli import WAYS, main, parse, usage
from sc3d.commands import COMMANDS, STAGES
from sc3d.commands.renamed import current
from tests.builders import write_bare_scene


@pytest.fixture
def scene(tmp_path):
    return write_bare_scene(tmp_path / "scene")


def fails(capsys, *arguments, status: int = 2, command=main) -> str:
    """Run a command that must fail; returns its one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        command([str(argument) for argument in arguments])
    error = capsys.readouterr().err
    assert stopped.value.code == status, error
    lines = [line for line in error.splitlines() if line.startswith("sc3d:")]
    assert len(lines) == 1 and "Traceback" not in error, error
    return lines[0]


def files(folder: Path) -> set:
    return {
        (str(file.relative_to(folder)), file.stat().st_size) for file in folder.rglob("*") if file.is_file()
    }


@pytest.mark.parametrize(
    ("name", "options", "first"),
    [
        ("sky", (), "segment"),
        ("tree", (), "depth"),
        ("sky", ("--depth.ignore-masks",), "depth"),
        ("sky", ("--depth.sky-masks", "sky"), "depth"),
    ],
)
def test_run_makes_masks_first_where_depth_takes_sky_from_them(scene, monkeypatch, name, options, first):
    """Else a second run would find masks that the first one's depth did not know, and do all again."""
    from sc3d.commands import run

    stages: list[str] = []
    table = [{"id": 1, "name": "road", "color": [1, 1, 1]}, {"id": 3, "name": name, "color": [9, 9, 9]}]
    (scene / "classes.json").write_text(json.dumps(table))
    for step in ("check", "tell_plan"):
        monkeypatch.setattr(run, step, lambda *arguments: None)
    monkeypatch.setattr(run, "prepare", lambda photos, scene, settings: settings)
    monkeypatch.setattr(run, "execute", lambda stage, *arguments: stages.append(stage))
    main(["run", "photos", str(scene), *options])
    others = [stage for stage in stages if stage != "segment"]
    surface = ["depth", "train", "extract", "label", "propagate", "report"]
    assert others == ["map_photos", "reconstruct", *surface]
    assert stages[2] == first and stages.index("segment") in (2, 5)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--extract.crop", "3"), "only 2 photos"),
        (("--depth.sky-masks", "none"), "--sky-masks none is missing"),
        (("--depth.sky-masks", "photos"), "no masks in photos"),
    ],
)
def test_run_refuses_before_the_first_stage(tmp_path, monkeypatch, capsys, options, told):
    monkeypatch.chdir(tmp_path)
    write_bare_scene(tmp_path / "given")
    Path("photos").mkdir()
    for name in ("photo_0", "photo_1"):
        Image.fromarray(np.zeros((120, 160, 3), np.uint8)).save(f"photos/{name}.jpg")
        (tmp_path / "masks").mkdir(exist_ok=True)
        (tmp_path / "given" / "masks" / f"{name}.png").rename(tmp_path / "masks" / f"{name}.png")
    classes = ("--classes", "given/classes.json", "--masks", "masks")
    assert told in fails(capsys, "run", "photos", "scene", *classes, *options)
    assert not Path("scene").exists()


@pytest.mark.parametrize("name", [*STAGES, *COMMANDS])
def test_help_answers_in_under_a_second(name):
    code = "from sc3d.cli import main; main()"
    before = os.times()
    result = subprocess.run(
        [sys.executable, "-c", code, name, "--help"], capture_output=True, text=True, env=os.environ
    )
    after = os.times()  # of the processor, as the machine may be busy
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    assert result.returncode == 0 and "usage: sc3d " + name in result.stdout
    assert spent < 1


def test_names_of_commands_stand_apart_from_what_they_do():
    for line in usage().splitlines()[2:]:
        name = line.split()[0]
        assert name in STAGES | COMMANDS and line[2 + len(name)] == " "


def test_usage_and_unknown_command(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    listed = capsys.readouterr().out
    assert stopped.value.code == 0 and all(name in listed for name in [*STAGES, *COMMANDS])
    assert "unknown command" in fails(capsys, "lable", "x")


def test_scripts_in_tools_are_the_commands():
    tools = Path(__file__).parent.parent / "tools"
    assert {file.stem for file in tools.glob("*.py")} - {
        "check_wheel",
        "demo",
        "fuzz_readers",
        "make_manual",
        "make_pictures",
        "docstring_pages",
        "__init__",
    } == {
        *STAGES,
        *COMMANDS,
    }
    result = subprocess.run(
        [sys.executable, str(tools / "label.py"), "--help"], capture_output=True, text=True, env=os.environ
    )
    assert "usage: sc3d label" in result.stdout


class TestBadInput:
    def check(self, capsys, scene, expected, *arguments):
        before = files(scene)
        message = fails(capsys, *arguments)
        assert all(word in message for word in expected), message
        assert files(scene) == before

    def test_no_photos(self, capsys, scene, tmp_path):
        (tmp_path / "empty").mkdir()
        self.check(capsys, scene, ["no photos", "empty"], "reconstruct", tmp_path / "empty", scene)
        self.check(capsys, scene, ["not a folder"], "reconstruct", tmp_path / "nowhere", scene)

    def test_unreadable_photo(self, capsys, scene, tmp_path):
        photos = tmp_path / "photos"
        photos.mkdir()
        Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(photos / "a.jpg")
        (photos / "b.jpg").write_bytes(b"not an image")
        self.check(capsys, scene, ["cannot read", "b.jpg"], "reconstruct", photos, scene)
        self.check(capsys, scene, ["cannot read", "b.jpg"], "run", photos, scene, "--masks", scene / "masks")

    def test_mask_for_an_unknown_photo(self, capsys, scene):
        Image.fromarray(np.ones((120, 160), np.uint8)).save(scene / "masks" / "other.png")
        self.check(capsys, scene, ["other.png", "no photo"], "label", scene)

    def test_mask_of_another_aspect(self, capsys, scene):
        Image.fromarray(np.ones((120, 150), np.uint8)).save(scene / "masks" / "photo_1.png")
        self.check(capsys, scene, ["photo_1.png", "150x120", "160x120"], "label", scene)

    def test_class_id_not_in_the_table(self, capsys, scene):
        Image.fromarray(np.full((120, 160), 2, np.uint8)).save(scene / "masks" / "photo_1.png")
        self.check(capsys, scene, ["photo_1.png", "class id 2"], "label", scene)

    def test_mask_with_colors(self, capsys, scene):
        Image.fromarray(np.full((120, 160, 3), 2, np.uint8)).save(scene / "masks" / "photo_1.png")
        self.check(capsys, scene, ["photo_1.png", "colors"], "label", scene)

    def test_missing_cameras(self, capsys, scene):
        for file in (scene / "sparse" / "0").iterdir():
            file.unlink()
        self.check(capsys, scene, ["no cameras", "reconstruct"], "label", scene)

    def test_broken_cameras(self, capsys, scene):
        (scene / "sparse" / "0" / "images.bin").write_bytes(b"\x05")
        self.check(capsys, scene, ["COLMAP model"], "label", scene)

    def test_empty_cloud(self, capsys, scene):
        (scene / "cloud.ply").write_text(
            "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        )
        self.check(capsys, scene, ["no points"], "label", scene)

    def test_points_that_are_not_numbers(self, capsys, scene):
        points = np.zeros((10, 3))
        points[3, 1] = np.nan
        o3d.t.io.write_point_cloud(
            str(scene / "cloud.ply"), o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
        )
        self.check(capsys, scene, ["not finite"], "label", scene)

    @pytest.mark.parametrize("share", [0.5, 0.999])
    def test_truncated_ply(self, capsys, scene, share):
        content = (scene / "cloud.ply").read_bytes()
        (scene / "cloud.ply").write_bytes(content[: int(share * len(content))])
        self.check(capsys, scene, ["truncated"], "label", scene)

    def test_not_a_ply(self, capsys, scene):
        (scene / "cloud.ply").write_text("hello")
        self.check(capsys, scene, ["not a PLY"], "label", scene)

    def test_class_table(self, capsys, scene):
        for broken, word in (
            ([], "non-empty"),
            ([{"id": 0, "name": "a", "color": [0, 0, 0]}], "0 means unlabelled"),
            ([{"id": 1, "name": "a", "color": [0, 0, 999]}], "color"),
            ([{"id": 1, "name": "a", "color": [0, 0, 0]}] * 2, "twice"),
        ):
            (scene / "classes.json").write_text(json.dumps(broken))
            self.check(capsys, scene, [word], "label", scene)
        (scene / "classes.json").write_text("{")
        self.check(capsys, scene, ["JSON"], "label", scene)
        (scene / "classes.json").unlink()
        self.check(capsys, scene, ["classes.json is missing"], "label", scene)

    def test_steps_in_the_wrong_order(self, capsys, scene):
        self.check(capsys, scene, ["run `sc3d label"], "propagate", scene)
        self.check(capsys, scene, ["run `sc3d propagate"], "evaluate", scene)
        self.check(capsys, scene, ["run `sc3d train"], "extract", scene)
        self.check(capsys, scene, ["cannot read the image"], "train", scene)

    def test_scene_that_does_not_exist(self, capsys, scene, tmp_path):
        self.check(capsys, scene, ["does not exist"], "view", tmp_path / "nowhere")

    def test_photo_names_that_leave_the_scene(self, capsys, scene):
        import shutil

        from tests.builders import views, write_model

        shutil.rmtree(scene / "sparse")
        evil = views()
        object.__setattr__(evil[0], "name", "../../etc/passwd")
        write_model(scene / "sparse" / "0", evil)
        self.check(capsys, scene, ["outside the scene"], "label", scene)

    def test_folder_without_permission_to_write(self, capsys):
        with tempfile.TemporaryDirectory() as folder:  # pytest's own folder is closed to others
            os.chmod(folder, 0o755)
            scene = write_bare_scene(Path(folder) / "scene")
            before = files(scene)
            os.chmod(scene, 0o555)
            if os.getuid() == 0:  # root may write anywhere
                os.seteuid(65534)
            try:
                message = fails(capsys, "label", scene)
            finally:
                os.seteuid(os.getuid())
                os.chmod(scene, 0o755)
            assert "cannot write" in message and "permissions" in message
            assert files(scene) == before

    def test_usage_errors_exit_with_2(self, capsys, scene):
        with pytest.raises(SystemExit) as stopped:
            main(["label", str(scene), "--consensus", "much"])
        assert stopped.value.code == 2


def test_interrupted_output_leaves_the_old_file(tmp_path):
    from sc3d.io.atomic import atomic_path

    target = tmp_path / "cloud.ply"
    target.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old" and list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("before", "now"),
    [
        (["--from", "centres"], ["--from", "centers"]),
        (["--from=centres"], ["--from=centers"]),
        (["--num_neighbours", "4"], ["--num-neighbors", "4"]),
        (["--train.num-neighbours=4"], ["--train.num-neighbors=4"]),
        (["--train.no-exposure", "--no_exposure"], ["--train.exposure=none", "--exposure=none"]),
        (
            ["--label.no-range", "--label.incidence"],
            ["--label.mechanisms.no-range", "--label.mechanisms.incidence"],
        ),
    ],
)
def test_options_as_they_were_spelled_before_are_taken_with_a_warning(before, now, caplog):
    with caplog.at_level("WARNING"):
        assert current(["scene", *before]) == ["scene", *now]
    assert set(now) - set(before) and all(new in caplog.text for new in set(now) - set(before))
    caplog.clear()
    assert current(["centres", *now]) == ["centres", *now] and not caplog.text  # a scene may be called so


def test_old_spellings_reach_the_records(tmp_path):
    assert parse("extract", current([str(tmp_path), "--from", "centres"]))[0].settings.method == "centers"
    assert parse("train", current([str(tmp_path), "--num-neighbours", "5"]))[0].settings.num_neighbors == 5
    assert parse("train", current([str(tmp_path), "--no-exposure"]))[0].settings.exposure == "none"
    assert parse("run", current(["a", "b", "--label.incidence"]))[0].label.mechanisms.incidence


@pytest.mark.parametrize(
    "share, fill", [("0", "nothing"), ("0.0", "nothing"), ("0.97", "occluders"), ("None", "occluders")]
)
def test_coverage_is_told_what_it_is_now(tmp_path, caplog, share, fill):
    for arguments in (["--coverage", share], [f"--coverage={share}"]):
        caplog.clear()
        assert parse("extract", current([str(tmp_path), *arguments]))[0].settings.fill == fill
        assert f"--coverage {share} is --fill {fill} now" in caplog.text
    assert parse("run", current(["a", "b", "--extract.coverage", share]))[0].extract.fill == fill


def test_commands_that_became_tools_say_where_they_are(capsys):
    assert "python -m tools.benchmark speed --repeats 2" in fails(
        capsys, "benchmark", "speed", "--repeats", "2"
    )
    assert "tools/make_manual.py" in fails(capsys, "manual", "folder")


def test_without_arguments_the_three_usual_ways_are_shown_and_are_commands(capsys):
    with pytest.raises(SystemExit) as stopped:
        main([])
    shown = capsys.readouterr().out
    assert stopped.value.code == 2 and shown == WAYS + usage()
    assert len(re.findall(r"^  \S.*:$", WAYS, re.M)) == 3
    ways = re.findall(r"^    sc3d (\w+) (.*?)(?:   +.*)?$", WAYS, re.M)
    assert len(ways) == 9
    for name, arguments in ways:
        parse(name, arguments.split())  # exits if it does not fit


def test_help_of_run_has_the_everyday_options_first_then_stage_by_stage(capsys):
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    shown = capsys.readouterr().out
    groups = re.findall(r"^\W+([\w.]+) (?:options|arguments) \W+$", shown, re.M)
    stages = ["reconstruct", "depth", "train", "extract", "segment", "label", "label.mechanisms", "propagate"]
    assert groups == ["positional", *stages] and "[OPTIONS] PHOTOS SCENE" in shown
    everyday = shown[: shown.index("reconstruct options")]
    assert set(re.findall(r"^\W*?(--[a-z][a-z-]*)", everyday, re.M)) == {
        *("--masks", "--confidence", "--classes", "--truth", "--overwrite", "--quiet", "--verbose", "--log")
    }


def test_shell_completion_knows_commands_and_options(tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--tyro-write-completion", "bash", str(tmp_path / "completions" / "sc3d.sh")])
    assert not stopped.value.code
    script = (tmp_path / "completions" / "sc3d.sh").read_text()
    assert all(word in script for word in [*STAGES, *COMMANDS, "--label.consensus", "--quiet"])
    assert (
        subprocess.run(["bash", "-n", str(tmp_path / "completions" / "sc3d.sh")], check=False).returncode == 0
    )
    assert "takes a shell (bash, zsh, tcsh, fish)" in fails(capsys, "--tyro-print-completion", "csh")


def test_a_log_gets_the_messages_and_the_error(scene, tmp_path, capsys):
    log = tmp_path / "file.log"
    message = fails(capsys, "propagate", scene, "--quiet", "--log", log)
    assert log.read_text().endswith(f" {message}\n")
    assert "cannot write" in fails(capsys, "propagate", scene, "--log", tmp_path / "nowhere" / "file.log")


@pytest.mark.parametrize(
    "options",
    [
        ("label", "--prior-weight", "nan"),
        ("propagate", "--method", "geometry", "--save-model", "m.npz"),
        ("extract", "--crop", "2", "--from", "centers"),
    ],
)
def test_settings_that_do_not_go_together_are_one_line(scene, capsys, options):
    name, *rest = options
    fails(capsys, name, scene, *rest)


def test_sigterm_stays_ours_where_pycolmap_comes_later():
    """Its import brings a handler that prints a stack trace."""
    code = (
        "import os, signal, sys\nfrom sc3d.cli import Terminated, ending_when_told\n"
        "try:\n with ending_when_told():\n  import pycolmap\n  os.kill(os.getpid(), signal.SIGTERM)\n"
        "except Terminated:\n sys.exit(7)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 7
