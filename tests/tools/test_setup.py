"""The set-up scripts, with made-up interpreters: which Python and which PyTorch they choose and what they say."""

import configparser
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
TOOLS = ("bash", "sed", "uname", "id", "cat", "dirname", "cksum", "grep", "env", "awk")
CPU_INDEX = "--index-url https://download.pytorch.org/whl/cpu"
linux = pytest.mark.skipif(sys.platform != "linux", reason="runs set-up as on Linux")
pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="runs bash scripts")


def classifiers() -> list[str]:
    found = configparser.ConfigParser()
    found.read(ROOT / "setup.cfg", encoding="utf-8")
    lines = found["metadata"]["classifiers"].splitlines()
    return [line.split(":: ")[-1] for line in lines if ":: Python :: 3." in line]


def script(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!{shutil.which('bash')}\n{text}\n")
    path.chmod(0o755)


def interpreter(path: Path, version: str) -> None:
    """This Python, under another version."""
    numbers = ", ".join(version.split("."))
    script(
        path,
        f'code=$2; shift 2\nexec {sys.executable} -c "import sys; sys.version_info = ({numbers}, 0)\n$code" "$@"',
    )


@pytest.fixture
def place(tmp_path):
    """A folder bin/ that is the whole PATH, with nothing of Python."""
    (tmp_path / "bin").mkdir()
    for name in TOOLS:
        found = shutil.which(name)
        assert found, name
        (tmp_path / "bin" / name).symlink_to(found)
    return tmp_path


def bash(place: Path, *words: str, **variables: str) -> subprocess.CompletedProcess:
    environment = {"PATH": str(place / "bin"), "HOME": str(place), **variables}
    return subprocess.run(
        [shutil.which("bash"), *words], capture_output=True, text=True, env=environment, check=False
    )


def call(place: Path, function: str, **variables: str) -> subprocess.CompletedProcess:
    return bash(
        place, "-c", f"set -euo pipefail; root={ROOT}; source $root/tools/pythons.sh; {function}", **variables
    )


@pytest.mark.parametrize(
    ("there", "chosen"),
    [
        ({"python3": "3.12"}, "python3"),
        ({"python3": "3.12", "python3.14": "3.14"}, "python3"),
        ({"python3": "3.15", "python3.10": "3.10", "python3.13": "3.13"}, "python3.13"),
        ({"python3.11": "3.11"}, "python3.11"),
        ({"python3": "3.9", "python3.13": "3.12"}, None),  # of another version than its name says
        ({}, None),
    ],
)
def test_the_system_python_is_taken_if_it_fits_else_the_newest_that_does(place, there, chosen):
    for name, version in there.items():
        interpreter(place / "bin" / name, version)
    done = call(place, "find_python")
    assert done.stdout.strip() == (str(place / "bin" / chosen) if chosen else "")
    assert (done.returncode == 0) is bool(chosen)


def test_interpreters_of_pyenv_and_uv_are_found(place):
    interpreter(place / ".pyenv" / "versions" / "3.13.2" / "bin" / "python", "3.13")
    assert call(place, "find_python").stdout.strip().endswith("3.13.2/bin/python")
    interpreter(place / "uv" / "python", "3.14")
    script(place / "bin" / "uv", f'[ "$5" = 3.14 ] && echo {place}/uv/python')
    assert call(place, "find_python").stdout.strip() == str(place / "uv" / "python")


def test_a_python_that_was_asked_for_is_not_replaced_by_another(place):
    interpreter(place / "bin" / "python3", "3.12")
    interpreter(place / "bin" / "old", "3.9")
    done = call(place, "find_python", SC3D_PYTHON="old")
    assert done.returncode == 1 and not done.stdout and "old is no CPython 3.10 to 3.14" in done.stderr


def test_how_to_get_a_python_is_said(place):
    interpreter(place / "bin" / "python3", "3.15")
    done = bash(place, str(ROOT / "tools" / "setup.sh"), SC3D_VENV=str(place / "venv"))
    assert done.returncode == 1 and not (place / "venv").exists()
    assert "Python 3.10 to 3.14 is needed; python3 is 3.15" in done.stderr
    assert "uv python install 3.14" in done.stderr and "apt-get" not in done.stderr


def test_packages_of_the_system_are_named_where_they_may_not_be_installed(place):
    script(place / "bin" / "apt-cache", '[ "$2" = python3.13-venv ] && echo Package: $2')
    script(place / "bin" / "apt-get", "exit 100")
    done = bash(place, str(ROOT / "tools" / "setup.sh"), SC3D_VENV=str(place / "venv"))
    assert done.returncode == 1 and "python3 is not there" in done.stderr
    assert "sudo apt-get install --no-install-recommends python3.13-venv" in done.stderr


@linux
@pytest.mark.parametrize(
    ("gpu", "reached", "variables", "said", "index"),
    [
        (False, True, {}, "", CPU_INDEX),
        (False, False, {}, "up to 2.7 GB", ""),
        (True, True, {}, "comes with CUDA, 2.7 GB", ""),
        (True, True, {"SC3D_TORCH_INDEX": "https://else.where"}, "", "--index-url https://else.where"),
        (False, True, {"SC3D_TORCH_INDEX": ""}, "", ""),
    ],
)
def test_pytorch_comes_without_cuda_where_there_is_no_gpu(place, gpu, reached, variables, said, index):
    if not gpu and Path("/proc/driver/nvidia/version").exists():
        pytest.skip("this machine has a GPU")
    interpreter(place / "bin" / "python3", "3.12")
    script(place / "bin" / "dpkg", "exit 0")
    if gpu:
        script(place / "bin" / "nvidia-smi", "echo GPU 0: of a test")
    answer = 0 if reached else 1
    script(
        place / "venv" / "bin" / "python",
        f'echo "$@" >>{place}/log\ncase "$*" in *urlopen*) exit {answer};; *metadata*) exit 1;; esac',
    )
    done = bash(place, str(ROOT / "tools" / "setup.sh"), SC3D_VENV=str(place / "venv"), **variables)
    assert done.returncode == 0, done.stderr
    torch = next(line for line in (place / "log").read_text().splitlines() if " torch==" in line)
    words = "-m pip install --quiet --disable-pip-version-check"
    assert torch.rsplit(" ", 1)[0] == f"{words} {index}".strip()
    assert said in done.stderr and ("GB" in done.stderr) is bool(said)
    (place / "log").unlink()
    assert not bash(place, str(ROOT / "tools" / "setup.sh"), SC3D_VENV=str(place / "venv")).stderr
    assert not (place / "log").exists()  # finished set-up is not repeated


@linux
@pytest.mark.parametrize("failing", ["", "3.12"])
def test_tests_run_on_the_oldest_the_default_and_the_newest(place, failing):
    root = place / "root"
    for file in (*(ROOT / "tools").glob("*.sh"), ROOT / "tools" / "constraints.txt", ROOT / "setup.cfg"):
        (root / file.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, root / file.relative_to(ROOT))
    script(place / "bin" / "dpkg", "exit 0")
    for version, folder in {"3.10": ".venv-3.10", "3.12": ".venv"}.items():
        interpreter(place / "bin" / f"python{version}", version)
        interpreter(root / "real" / version, version)
        ending = f'case "$*" in "-m pytest "*) echo "$0" >>{place}/log; exit {int(version == failing)};; "-m pip "* | *open3d*) exit 0;; esac'
        script(root / folder / "bin" / "python", f'{ending}\nexec {root}/real/{version} "$@"')
    done = bash(place, str(root / "tools" / "test_pythons.sh"), SC3D_TORCH_INDEX="")
    assert "Error" not in done.stderr
    ran = (place / "log").read_text().split()
    assert ran == [str(root / folder / "bin" / "python") for folder in (".venv-3.10", ".venv")]
    first, second, third = done.stdout.splitlines()
    assert first.endswith("passed") and second.endswith("FAILED" if failing else "passed")
    assert (
        third == "Python 3.14: NOT RUN" and "uv python install 3.14" in done.stderr and done.returncode == 1
    )


@linux
def test_an_environment_of_another_python_is_not_used(place):
    interpreter(place / "bin" / "python3.14", "3.14")
    interpreter(place / "venv" / "bin" / "python", "3.11")
    done = bash(
        place, str(ROOT / "tools" / "setup.sh"), SC3D_VENV=str(place / "venv"), SC3D_PYTHON="python3.14"
    )
    assert done.returncode == 1 and "was made with 3.11: delete it" in done.stderr


def test_every_python_has_exactly_one_version_of_every_package():
    lines = (ROOT / "tools" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    for version in classifiers():
        names = [
            pin.name for pin in pins if pin.marker is None or pin.marker.evaluate({"python_version": version})
        ]
        assert sorted(names) == sorted({pin.name for pin in pins}), version


def test_the_oldest_python_is_the_one_that_style_and_types_are_checked_for():
    oldest = classifiers()[0]
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    assert f'target-version = "py{oldest.replace(".", "")}"' in settings
    assert f'python_version = "{oldest}"' in settings
    assert f"python_requires = >={oldest}\n" in (ROOT / "setup.cfg").read_text(encoding="utf-8")
    assert f"Python {oldest} to {classifiers()[-1]}" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_scripts_are_valid_bash():
    for file in (ROOT / "tools").glob("*.sh"):
        assert os.access(file, os.R_OK) and subprocess.run(["bash", "-n", file], check=False).returncode == 0


def test_the_image_has_the_libraries_that_the_set_up_installs():
    setup, image = (ROOT / "tools" / "setup.sh").read_text(), (ROOT / "Dockerfile").read_text()
    libraries = re.search(r"^libraries=\((.*)\)$", setup, re.M)
    assert libraries is not None and f"install-recommends {libraries[1]} \\\n" in image
    assert all(
        (ROOT / name).exists()
        for line in re.findall(r"^COPY (.*) \S+$", image, re.M)
        for name in line.split()
    )
