"""What `tools/check_wheel.py` looks for; it is run by hand and in CI, because it makes an environment."""

import configparser
import os
import zipfile

import pytest

from tools.check_wheel import ROOT, bare, require_complete


def test_data_files_of_the_package_are_named_in_the_set_up():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    named = {
        path
        for package, patterns in setup["options.package_data"].items()
        for pattern in patterns.split(",")
        for path in ROOT.joinpath(*package.split(".")).glob(pattern.strip())
    }
    files = {
        path for path in (ROOT / "sc3d").rglob("*") if path.is_file() and "__pycache__" not in path.parts
    }
    assert {path for path in files if path.suffix != ".py"} == named
    assert all((path.parent / "__init__.py").exists() for path in files)  # else find: passes the folder over


def test_a_wheel_without_a_file_of_the_package_is_refused(tmp_path):
    wheel = tmp_path / "sc3d-0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for path in (ROOT / "sc3d").rglob("*"):
            if path.suffix in (".py", ".typed", ".html", ".css"):
                archive.writestr(path.relative_to(ROOT).as_posix(), "")
    with pytest.raises(SystemExit, match=r"annotate/page\.js"):
        require_complete(wheel)


def test_commands_are_tried_without_the_checkout(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    assert "PYTHONPATH" not in bare() and bare()["PATH"] == os.environ["PATH"]
