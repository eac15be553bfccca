"""Points in glTF 2.0 files with buffers beside them: positions, colors, and the arrays of an extension."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from sc3d.errors import InputError
from sc3d.io.folders import resolved
from sc3d.io.json_files import read_json

KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
GRAY = 128


class Gltf:
    """A file whose arrays are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content: Any = read_json(path)
        if not isinstance(self.content, dict):
            raise InputError(f"{path} is no glTF file")

    @cached_property
    def buffers(self) -> list[Path]:
        return [self._beside(buffer["uri"]) for buffer in self.content.get("buffers", [])]

    def accessor(self, number: int) -> np.ndarray:
        """(N, K) values; TypeError or ValueError where a buffer is too small."""
        accessor = self.content["accessors"][number]
        view = self.content["bufferViews"][accessor["bufferView"]]
        kind, width, count = (
            np.dtype(KINDS[accessor["componentType"]]),
            SIZES[accessor["type"]],
            int(accessor["count"]),
        )
        offset = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
        stride = int(view.get("byteStride", width * kind.itemsize))
        if stride < width * kind.itemsize:
            raise ValueError("values that lie over one another")
        stored = np.memmap(self.buffers[view["buffer"]], np.uint8, "r")
        return np.ndarray((count, width), kind, stored, offset, (stride, kind.itemsize))

    def primitives(self) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
        """Primitives of the scene, and (4, 4) where they lie."""
        scenes = self.content.get("scenes", [])
        nodes = scenes[self.content.get("scene", 0)]["nodes"] if scenes else range(len(self.content["nodes"]))
        left, seen = [(int(node), np.eye(4)) for node in reversed(nodes)], set[int]()
        while left:
            number, outer = left.pop()
            if number in seen:
                raise ValueError("a node that is in two places")
            seen.add(number)
            node = self.content["nodes"][number]
            if {"rotation", "scale", "translation"} & set(node):
                raise ValueError("a node that is placed by other than a matrix")
            # by columns
            matrix = outer @ np.array(node.get("matrix", np.eye(4)), np.float64).reshape(4, 4).T
            left += [(int(child), matrix) for child in reversed(node.get("children", []))]
            if "mesh" in node:
                yield from ((part, matrix) for part in self.content["meshes"][node["mesh"]]["primitives"])

    def _beside(self, uri: str) -> Path:
        parts = urlsplit(uri)
        target = self.path.parent / unquote(parts.path)
        if parts.scheme or not resolved(target).is_relative_to(resolved(self.path.parent)):
            raise InputError(
                f"{self.path} names {uri[:80]!r}, which is not in its folder: put the file there"
            )
        return target


@dataclass(frozen=True)
class GltfPoints:
    """positions: (N, 3) float64, y up; colors: (N, 3) uint8, gray without any; extension: its content, {} if
    there is none
    """

    gltf: Gltf
    positions: np.ndarray
    colors: np.ndarray
    extension: dict[str, Any]

    def accessor(self, number: int) -> np.ndarray:
        """(N, K) of an array that the extension names."""
        return self.gltf.accessor(number)


def gltf_buffers(path: Path) -> list[Path]:
    """Files that hold the arrays."""
    return Gltf(path).buffers


def read_gltf_points(path: Path, extension: str) -> list[GltfPoints]:
    """Every primitive of the scene. InputError for a file whose buffers are missing."""
    gltf = Gltf(path)
    gone = [buffer.name for buffer in gltf.buffers if not buffer.is_file()]
    if gone:
        raise InputError(f"{path} needs {gone[0]}, which is missing: export or copy it again")
    return [_points(gltf, primitive, matrix, extension) for primitive, matrix in gltf.primitives()]


def _points(gltf: Gltf, primitive: dict[str, Any], matrix: np.ndarray, extension: str) -> GltfPoints:
    attributes = primitive["attributes"]
    positions = gltf.accessor(attributes["POSITION"]).astype(np.float64)
    if not np.isfinite(positions).all():
        raise ValueError("positions that are not finite")
    colors = np.full((len(positions), 3), GRAY, np.uint8)
    if "COLOR_0" in attributes:
        colors = np.array(gltf.accessor(attributes["COLOR_0"])[:, :3])
        if colors.dtype != np.uint8 or len(colors) != len(positions):
            raise ValueError("colors that are not bytes, or not one for each point")
    return GltfPoints(
        gltf,
        positions @ matrix[:3, :3].T + matrix[:3, 3],
        colors,
        primitive.get("extensions", {}).get(extension, {}),
    )
