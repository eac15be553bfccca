"""What sc3d needs from the machine: packages of Python and of the system; what an import error says about them,
in a line that tells how to install them.
"""

from __future__ import annotations

import errno
import re
from importlib import metadata

# packages of Debian and Ubuntu that hold the libraries which Open3D, OpenCV, pycolmap, torch and rasterio load
# from the system
LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libOpenGL.so.0": "libopengl0",
    "libSM.so.6": "libsm6",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libexpat.so.1": "libexpat1",
    "libgcc_s.so.1": "libgcc-s1",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libgomp.so.1": "libgomp1",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libvulkan.so.1": "libvulkan1 mesa-vulkan-drivers",
    "libz.so.1": "zlib1g",
}
# slim systems lack these; without libgomp numba's kernels fall back to a slower pool of threads
ALWAYS = ("libGL.so.1", "libEGL.so.1", "libusb-1.0.so.0", "libvulkan.so.1", "libgomp.so.1")
NO_CACHE = "cannot cache function"  # numba
OUT_OF_MEMORY = "not enough memory"  # torch
LESS_MEMORY = "end other programs, use a smaller --max-size where there is one, or a lower --max-memory, so that the work is done part by part"
INSTALL = "sudo apt-get install --no-install-recommends"
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "sklearn": "scikit-learn"}  # by module
NEED = re.compile(
    r"(?P<name>[\w.-]+)(?:\[[\w,]*\])?(?P<limits>[^;]*)(?:;.*extra == ['\"](?P<extra>\w+)['\"])?"
)


def explain(error: BaseException) -> str | None:
    """One line about what is missing or too old, and how to get it: a library, a package, memory, a place for
    compiled kernels; None for errors of other kinds.
    """
    text = str(error)
    if (
        isinstance(error, MemoryError)
        or getattr(error, "errno", None) == errno.ENOMEM
        or OUT_OF_MEMORY in text
    ):
        return f"not enough memory{f' ({text})' if text else ''}: {LESS_MEMORY}"
    if NO_CACHE in text:
        return (
            f"compiled kernels have no place ({text}): let NUMBA_CACHE_DIR name a folder that can be written"
        )
    if found := re.search(r"([\w.+-]+\.so[\w.]*): cannot open shared object file", text):
        return _missing_library(found[1])
    if found := re.search(r"version `([\w.]+)' not found \(required by ([^)]+)\)", text):
        return f"this system is too old for {found[2]}: it lacks {found[1]}; use a newer one, or an older package"
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("sc3d"):
        name = DISTRIBUTIONS.get(error.name.split(".")[0], error.name.split(".")[0])
        return f"the Python package {name} is missing: pip install {_pip_name(name)}"
    if isinstance(error, ImportError | AttributeError) and (old := outdated()):
        return f"{text}: {', '.join(old)}; pip install --upgrade them"
    return None


def _missing_library(name: str) -> str:
    if name not in LIBRARIES:
        return f"the library {name} is missing: install the system package that holds it (`apt-file search {name}` names it)"
    wanted = dict.fromkeys((LIBRARIES[name], *(LIBRARIES[other] for other in ALWAYS[:3])))
    packages = wanted if name in ALWAYS else [LIBRARIES[name]]
    return f"the library {name} is missing: {INSTALL} {' '.join(packages)} (`sc3d doctor` shows what else is)"


def _needs() -> list[re.Match]:
    """What this version of sc3d asks for; nothing in a checkout that is not installed."""
    try:
        lines = metadata.requires("sc3d") or []
    except metadata.PackageNotFoundError:
        return []
    return [found for line in lines if (found := NEED.match(line))]


def _pip_name(name: str) -> str:
    """The extra of sc3d that brings a package, or else the package."""
    extras = [found["extra"] for found in _needs() if _plain(found["name"]) == _plain(name)]
    wanted = [extra for extra in extras if extra and extra not in ("all", "test", "lint")]
    return f"'sc3d[{wanted[0]}]'" if wanted and None not in extras else name


def outdated() -> list[str]:
    """Installed packages that are older than sc3d needs, each as "name 1.0 is older than 2.0"."""
    result = []
    for found in _needs():
        least = re.search(r">=\s*([\d.]+)", found["limits"])
        try:
            version = metadata.version(found["name"])
        except metadata.PackageNotFoundError:
            continue
        if least and _numbers(version) < _numbers(least[1]):
            result.append(f"{found['name']} {version} is older than {least[1]}")
    return list(dict.fromkeys(result))


def _numbers(version: str) -> tuple[int, ...]:
    found = re.match(r"[\d.]+", version)
    numbers = [int(part) for part in found[0].split(".") if part] if found else []
    while numbers and not numbers[-1]:
        numbers.pop()
    return tuple(numbers)


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
