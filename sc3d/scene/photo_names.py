"""Names of photos: where the files that belong to a photo lie, and which photo a foreign name means.

A photo is named by its path below `images/`, with forward slashes. Its mask, and all else that is kept per
photo (confidence, truth, strokes, instances), is named like it: by the file name without suffix while no two
photos share that (`masks/DJI_0001.png`), else by the path without suffix (`masks/100MEDIA/DJI_0001.png`), and
by the path with it where photos of one folder differ in nothing else (`masks/a.jpg.png`). Whatever is clear
is found: a path as well.

Other programs leave out folders or suffixes, and add words and hashes. A foreign name means the photos that
fit it best; the caller decides what to do with none or several.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import unquote

from sc3d.errors import InputError
from sc3d.io.folders import resolved
from sc3d.io.photo_folder import IMAGE_SUFFIXES

# of a foreign name; all others belong to the name
SUFFIXES = IMAGE_SUFFIXES | set(".json .webp .bmp .gif .dng .heic .heif .arw .cr2 .nef .raw .rw2".split())
PHOTO = "{photo}"  # stands for the photo in a pattern
NUM_NEAREST = 3  # names that an error shows
_MAX_REDUCTIONS = 6  # words and hashes that are taken off one name
_CAMERA_FOLDER = re.compile(
    r"[1-9]\d\d\w{5}"
)  # as cameras name them (DCF, JEITA CP-3461): 100MEDIA, 101_PANO
# parts of a data set, as YOLO, COCO (train2017) and Roboflow name their folders
_SPLIT = re.compile(r"(?:train|training|trainval|val|valid|validation|test|testing)[-_]?\d*")

# What annotation programs and data sets write before or behind the name of the photo: FloodNet's _lab,
# Cityscapes' _gtFine_labelIds, CamVid's _L, Segments.ai's _label_ground-truth, ...
_WORD = (
    "masks?|labels?|lab|label_?ids|label_?train_?ids|train_?ids|gt_?fine|gt_?coarse|gt|ground|truth|colou?rs?|"
    "segmentation|segm?|semantic|annotations?|anno|class(?:es)?|watershed|confidence|conf"
)
_HASH = r"[0-9a-f]{8}-(?:[0-9a-f]{4}-){3}[0-9a-f]{12}|[0-9a-f]{8,64}"
_DATE = re.compile(r"(?:19|20)\d\d[01]\d[0-3]\d\d*")
_WORD_BEHIND = re.compile(rf"(.+)[-_. ](?:{_WORD})", re.IGNORECASE)
_WORD_BEFORE = re.compile(r"(?:mask|label|gt|seg)[-_. ](.+)", re.IGNORECASE)
_CAMVID = re.compile(r"(.+)_L")
_HASH_BEHIND = re.compile(rf"(.+?)[-_.]({_HASH})", re.IGNORECASE)
_HASH_BEFORE = re.compile(rf"({_HASH})[-_](.+)", re.IGNORECASE)  # Label Studio: 8 digits and a dash
_ROBOFLOW = re.compile(r"(.+)\.rf\.\w+")
_ROBOFLOW_SUFFIX = re.compile(r"(.+)_(?:jpe?g|png|tiff?|webp|bmp)", re.IGNORECASE)
_PHOTO_WORD = re.compile(r"(.+)_leftImg8bit")  # Cityscapes


def photo_name(photo: Path, images: Path) -> str:
    """Name of a photo: its path below `images`, with forward slashes on every system."""
    return photo.relative_to(images).as_posix()


def stem(name: str) -> str:
    """File name without folders (of any system) and without the suffix of an image; other dots belong to the
    name.
    """
    path = PureWindowsPath(name)
    return path.stem if path.suffix.lower() in SUFFIXES else path.name


class NamePattern:
    """How files are named, given by the user: `{photo}` stands for the photo's name, `*` for anything."""

    def __init__(self, text: str) -> None:
        """InputError unless `{photo}` is in it once."""
        if text.count(PHOTO) != 1:
            raise InputError(
                f"--name-pattern {text!r} must hold {PHOTO} once, in the place of the photo's name, "
                f"such as '{PHOTO}_lab.png'"
            )
        self.text, self._depth = text, text.count("/")
        self._whole = PurePosixPath(text).suffix.lower() in SUFFIXES
        self._before, self._behind = (_as_expression(part) for part in text.split(PHOTO))

    def photos(self, path: str) -> list[str]:
        """What `{photo}` may stand for in a path, with the folders before it."""
        parts = path.split("/")
        folders, name = parts[: -1 - self._depth], "/".join(parts[-1 - self._depth :])
        suffix = PurePosixPath(name).suffix
        if not self._whole and suffix.lower() in SUFFIXES:
            name = name.removesuffix(suffix)
        starts = [start for start in range(len(name)) if self._before.fullmatch(name[:start])]
        ends = [end for end in range(1, len(name) + 1) if self._behind.fullmatch(name[end:])]
        return ["/".join([*folders, name[start:end]]) for start in starts for end in ends if start < end]


class PhotoNames:
    """All photos of a scene by name."""

    def __init__(self, names: Iterable[str], pattern: NamePattern | None = None) -> None:
        """names: paths below `images/`; pattern: how foreign names are made, in place of the rules of
        programs
        """
        self.names = tuple(dict.fromkeys(names))
        self.pattern = pattern
        self._keys = _unique_keys(self.names)
        self._by_key = {key: name for name, key in self._keys.items()}
        self._tables: tuple[dict[str, list[str]], ...] = tuple(defaultdict(list) for _ in range(4))
        self._slugs: dict[str, list[str]] = defaultdict(list)
        for name in self.names:
            file = PurePosixPath(name).name
            own = PurePosixPath(name).stem
            for table, key in zip(self._tables, (file, _fold(file), own, _fold(own))):
                table[key].append(name)
            for slug in {_slug(file), _slug(own), _slug(_PHOTO_WORD.sub(r"\1", own))}:
                self._slugs[slug].append(name)

    def __len__(self) -> int:
        return len(self.names)

    def key(self, name: str) -> str:
        """What the files of a photo are named, without their own suffix."""
        return self._keys[name]

    def path(self, folder: Path, name: str, suffix: str = ".png") -> Path:
        """Where the file of a photo belongs in a folder such as `masks/`."""
        return folder / f"{self._keys[name]}{suffix}"

    def find(self, folder: Path, name: str, suffix: str = ".png") -> Path | None:
        """The file of a photo in a folder of the scene: named like it, or by path or file name where that is
        clear; None if there is none.
        """
        path = PurePosixPath(name)
        keys = dict.fromkeys([self._keys.get(name, name), str(path.with_suffix("")), path.stem])
        clear = (key for key in keys if self.match_file(f"{key}{suffix}") == (name,))
        return next((file for key in clear if (file := folder / f"{key}{suffix}").is_file()), None)

    def same_letters(self, name: str) -> list[str]:
        """Photos whose path differs from a name in letter case or Unicode form at most."""
        return [
            photo
            for photo in self._tables[1].get(_fold(name).rpartition("/")[2], ())
            if _fold(photo) == _fold(name)
        ]

    def match_file(self, path: str, folder: Path | None = None, changed: bool = True) -> tuple[str, ...]:
        """Photos that a mask or another file of one photo may belong to.

        path: below the folder of masks; changed: as for `match`
        folder: that folder, whose own name may tell what `path` does not
        """
        path = _normal(path)
        key = path.removesuffix(PurePosixPath(path).suffix)
        if self.pattern is None and key in self._by_key:
            return (self._by_key[key],)
        told = key if self.pattern is None else path
        found = self.match(told, changed)
        if len(found) > 1 and folder is not None:
            found = self.match(f"{resolved(folder).as_posix()}/{told}", changed)
        return found

    def match(self, foreign: str, changed: bool = True) -> tuple[str, ...]:
        """Photos that a name of another program may mean, the best that there are, in order: one if the name
        is clear.

        foreign: a name or path of any system, with or without suffix; changed: whether words and hashes of
            programs may be in it
        """
        path = _normal(foreign)
        if self.pattern is None:
            return self._as_written(path) or (self._as_changed(path) if changed else ())
        return tuple(
            sorted({name for photo in self.pattern.photos(path) for name in self._as_written(photo)})
        )

    def _as_written(self, path: str) -> tuple[str, ...]:
        """Photos whose name differs in folders, suffix, letter case or Unicode form only: those that no other
        photo outdoes both in folders and in exactness.
        """
        if path in self._keys:
            return (path,)
        *folders, file = path.split("/")
        ranks: dict[str, tuple[int, int]] = {}
        keys = _spellings(file)
        # a.jpg.json is of a.jpg, and a.jpg is the stem of a.jpg.png
        for table, key in ((0, 0), (1, 1), (2, 2), (0, 2), (2, 0), (3, 3), (1, 3), (3, 1)):
            for name in self._tables[table].get(keys[key], ()):
                if name not in ranks and not _contradicts(folders, name):
                    ranks[name] = _shared(folders, name), -max(table, key)
        most = max((shared for shared, _ in ranks.values()), default=0)
        ranks = {  # those in another folder, if one is in the same
            name: rank
            for name, rank in ranks.items()
            if rank[0] == most or rank[0] == min(len(folders), name.count("/"))
        }
        best = (
            name
            for name, rank in ranks.items()
            if not any(
                other != rank and other[0] >= rank[0] and other[1] >= rank[1] for other in ranks.values()
            )
        )
        return tuple(sorted(best))

    def _as_changed(self, path: str) -> tuple[str, ...]:
        """Photos whose name is found once words and hashes of annotation programs are taken off: as few as
        possible.
        """
        *folders, file = path.split("/")
        names, known = {stem(file)}, set()
        for _ in range(_MAX_REDUCTIONS):
            found = {
                name
                for reduced in names
                for name in self._as_written("/".join([*folders, reduced]))
                or self._slugs.get(_slug(reduced), ())
                if not _contradicts(folders, name)
            }
            if found:
                shared = {name: _shared(folders, name) for name in found}
                return tuple(sorted(name for name in found if shared[name] == max(shared.values())))
            known |= names
            names = {shorter for name in names for shorter in _reductions(name)} - known
        return ()

    def one(self, name: str, where: Path) -> str:
        """The photo that a user asks for by a name, of which suffix and folders may be missing; InputError,
        that names the photos in `where`, unless that is one.
        """
        found = self.match(name, changed=False)
        if len(found) == 1:
            return found[0]
        likely = found or self.nearest(name) or self.names[:5]
        raise InputError(
            f"{'several photos are' if found else 'no photo'} {name!r} in {where}: "
            f"one of {', '.join(likely)} ..."
        )

    def nearest(self, foreign: str) -> list[str]:
        """Photos whose names are most like a foreign one; none if nothing is."""
        by_stem = {_fold(PurePosixPath(name).stem): name for name in reversed(self.names)}
        text = _fold(stem(foreign))
        inside = sorted((part for part in by_stem if part in text), key=len, reverse=True)
        near = inside or get_close_matches(text, by_stem, NUM_NEAREST)
        return [by_stem[part] for part in near[:NUM_NEAREST]]

    def advice(self, foreign: str) -> str:
        """What an error says of a name that no photo has: the nearest names and, where one is a part of it,
        the pattern that would fit; empty if nothing is near.
        """
        if self.pattern is not None:
            return f"; --name-pattern is {self.pattern.text!r}"
        near = self.nearest(foreign)
        if not near:
            return ""
        text, part = _normal(foreign).rpartition("/")[2], PurePosixPath(near[0]).stem
        told, (before, found, behind) = f"; nearly fits {', '.join(near)}", text.partition(part)
        if not found or stem(text) == part:
            return told
        return f"{told}: if it belongs there, --name-pattern '{before}{PHOTO}{behind}' says so"

    def choices(self, names: Iterable[str], suffix: str = ".png") -> str:
        """What an error says of a name that several photos have: those photos, and how a file of each is
        named.
        """
        return " or ".join(f"{name} (whose file is {self._keys[name]}{suffix})" for name in names)


def shared_folders(foreign: str, name: str) -> int:
    """Folders directly above a foreign path and a photo that are named alike."""
    return _shared(_normal(foreign).split("/")[:-1], name)


def files_of_photos(folder: Path, names: PhotoNames, suffixes: Iterable[str]) -> list[Path]:
    """Files of a folder that may belong to photos, by path: those in it, and those in folders below that are
    named like folders of the photos, as cameras name folders, or as the parts of a data set (train, val, test);
    others hold something else. All files below where those have none, and those that fit the pattern if there
    is one.
    """
    files = _files_below(folder, set(suffixes))
    if names.pattern is not None:
        return files
    allowed = {""}
    for name in names.names:
        parts = [_fold(part) for part in name.split("/")[:-1]]
        allowed |= {"/".join(parts[start:]) for start in range(len(parts))}
    return [file for file in files if _is_place(file.relative_to(folder).parts[:-1], allowed)] or files


def _files_below(folder: Path, suffixes: set[str]) -> list[Path]:
    """Files of a folder and the folders below that are not hidden, by path."""
    found = []
    for place, folders, files in os.walk(folder):
        folders[:] = [below for below in folders if not below.startswith(".")]
        found += [
            Path(place, file)
            for file in files
            if not file.startswith(".") and Path(file).suffix.lower() in suffixes
        ]
    return sorted(file for file in found if file.is_file())


def _is_place(parts: tuple[str, ...], allowed: set[str]) -> bool:
    """Whether folders are among the allowed, but for those of the parts of a data set."""
    folders = [_fold(part) for part in parts]
    rest = [part for part in folders if not _SPLIT.fullmatch(part)]
    if "/".join(folders) in allowed or "/".join(rest) in allowed:
        return True
    return _is_camera_folder(rest) and len(rest) <= max(
        len(place.split("/")) if place else 0 for place in allowed
    )


def _unique_keys(names: tuple[str, ...]) -> dict[str, str]:
    """What the files of each photo are named, without their own suffix."""
    keys = {name: PurePosixPath(name).stem for name in names}
    if len(set(keys.values())) == len(keys):
        return keys
    keys = {name: str(PurePosixPath(name).with_suffix("")) for name in names}
    while True:
        counts = Counter(keys.values())
        double = [name for name, key in keys.items() if counts[key] > 1 and key != name]
        if not double:
            return keys
        keys |= {name: name for name in double}


def _reductions(name: str) -> set[str]:
    """A name with one thing less of what programs add to it."""
    found = {unquote(name), stem(name)}
    for expression in (_WORD_BEHIND, _WORD_BEFORE, _CAMVID, _ROBOFLOW, _ROBOFLOW_SUFFIX):
        if match := expression.fullmatch(name):
            found.add(match[1])
    for expression, kept, code in ((_HASH_BEHIND, 1, 2), (_HASH_BEFORE, 2, 1)):
        match = expression.fullmatch(name)
        if match and not _DATE.fullmatch(match[code]) and (code == 1 or not match[code].isdigit()):
            found.add(match[kept])
    return found - {name}


def _is_camera_folder(folders: list[str]) -> bool:
    return bool(folders) and _CAMERA_FOLDER.fullmatch(folders[-1]) is not None


def _contradicts(folders: list[str], name: str) -> bool:
    """Whether a camera put the two into different folders, where it counts photos anew."""
    own = name.split("/")[:-1]
    return _is_camera_folder(folders) and _is_camera_folder(own) and _fold(folders[-1]) != _fold(own[-1])


def _shared(folders: list[str], name: str) -> int:
    """Folders directly above the two that are named alike."""
    shared = 0
    for one, other in zip(reversed(folders), reversed(name.split("/")[:-1])):
        if _fold(one) != _fold(other):
            break
        shared += 1
    return shared


def _spellings(file: str) -> tuple[str, str, str, str]:
    """What a file name is looked up by, the most exact first."""
    return file, _fold(file), stem(file), _fold(stem(file))


def _normal(path: str) -> str:
    return path.replace("\\", "/").removeprefix("./")


def _fold(name: str) -> str:
    """Equal for names that differ in letter case or Unicode form (macOS takes letters and accents apart)."""
    return unicodedata.normalize("NFC", name).casefold()


def _slug(name: str) -> str:
    """Equal for names that differ in what programs put in place of blanks and punctuation."""
    return re.sub(r"[\W_]+", "-", _fold(name)).strip("-")


def _as_expression(text: str) -> re.Pattern[str]:
    return re.compile(".*".join(map(re.escape, text.split("*"))), re.IGNORECASE)
