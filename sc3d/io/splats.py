"""Gaussians in the PLY that 3DGS viewers read, as plain arrays.

Columns: x y z, nx ny nz, f_dc (3), f_rest (0, 9, 24 or 45, color channel by color channel), opacity (a
logit), scale (3 logarithms), rot (wxyz). Others' variants: two scales (2DGS,
https://github.com/hbb1/2d-gaussian-splatting: flat along the third axis), filter_3D (Mip-Splatting,
https://github.com/autonomousvision/mip-splatting: a width that is added to the scales).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.limits import FARTHEST
from sc3d.io.ply import Header, check_ply, read_columns, read_header, read_records, write_records

logger = logging.getLogger(__name__)

# largest absolute values: the square of a larger scale is no float32
LIMITS = {
    "means": FARTHEST,
    "log_scales": 40.0,
    "quats": 1e6,
    "opacity_logits": np.inf,
    "sh_dc": 1e6,
    "sh_rest": 1e6,
}
NORMALS = ["nx", "ny", "nz"]
ORIGIN = "sc3d origin"
DEGREES = {0: 0, 9: 1, 24: 2, 45: 3}  # of the harmonics, by the number of f_rest properties
FLAT = 1e-3  # third scale of a Gaussian that has two, times the smaller of them
# what is said of a file that was meant to be a cloud
SPLATS = (
    "holds Gaussian splats, not a cloud: copy it to SCENE/gaussians.ply as a plain splat PLY,"
    " and run `sc3d extract SCENE`"
)
OTHER_FORMATS = {".splat", ".spz", ".ksplat", ".sog"}


def origin_comment(origin: np.ndarray) -> str:
    """The comment that says where the origin of the local frame, (3,) world, lies."""
    return f"{ORIGIN} {origin[0]:.3f} {origin[1]:.3f} {origin[2]:.3f}"


def write_splat_ply(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    comments: Sequence[str] = (),
    extra: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write float32 arrays as `read_splat_ply` returns them; positions stay in their local frame.

    arrays: also "normals" (N, 3); extra: further properties (N,), uint8 or float32, which viewers ignore
    """
    size = len(arrays["means"])
    rest = arrays["sh_rest"].transpose(0, 2, 1).reshape(size, -1)
    columns = {
        **_split(list("xyz"), arrays["means"]),
        **_split(NORMALS, arrays["normals"]),
        **_split(_numbered("f_dc", 3), arrays["sh_dc"]),
        **_split(_numbered("f_rest", rest.shape[1]), rest),
        "opacity": arrays["opacity_logits"],
        **_split(_numbered("scale", 3), arrays["log_scales"]),
        **_split(_numbered("rot", 4), arrays["quats"]),
        **(extra or {}),
    }
    bytes_of = {name: values.dtype == np.uint8 for name, values in columns.items()}
    table = np.empty(size, [(name, "u1" if byte else "<f4") for name, byte in bytes_of.items()])
    for name, values in columns.items():
        table[name] = values
    write_records(path, table, comments=comments)


def read_splat_ply(
    path: Path, model_origin: np.ndarray | None = None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read a 3DGS PLY.

    model_origin: (3,) world, what to subtract from positions that are in the frame of the cameras' model, as
        those of other programs are: of files without the comment that `origin_comment` makes
    returns: float32 arrays means (N, 3), local frame; log_scales (N, 3); quats (N, 4) wxyz of any length
        but 0; opacity_logits (N,); sh_dc (N, 3); sh_rest (N, K - 1, 3), K = 1, 4, 9, 16; and the comment
        lines
    Raises InputError for another file, and for values that cannot be rendered.
    """
    _refuse_compressed(path)
    table, comments = _read_table(path)
    columns = _Columns(path, table)
    num_rest = columns.count("f_rest_")
    if num_rest not in DEGREES:
        raise InputError(
            f"{path} has {num_rest} f_rest properties; 0, 9, 24 or 45 belong to degrees 0 to 3: save it with spherical harmonics of degree 3 or less"
        )
    means = columns.read(list("xyz"), np.float64)
    if model_origin is not None and not any(line.startswith(ORIGIN) for line in comments):
        means -= model_origin
    arrays = {
        "means": means.astype(np.float32),
        "log_scales": _log_scales(columns),
        "quats": columns.read(_numbered("rot", 4)),
        "opacity_logits": columns.read(["opacity"])[:, 0],
        "sh_dc": columns.read(_numbered("f_dc", 3)),
        "sh_rest": np.zeros((len(table), 0, 3), np.float32),
    }
    if num_rest:
        rest = columns.read(_numbered("f_rest", num_rest)).reshape(len(table), 3, num_rest // 3)
        arrays["sh_rest"] = np.ascontiguousarray(rest.transpose(0, 2, 1))
    if columns.count("filter_3D"):
        _widen(arrays, columns.read(["filter_3D"]))
    check_splats(arrays, path)
    _repair_turns(arrays, path)
    _doubt_activated(arrays, path)
    return arrays, list(comments)


def _read_table(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """As `read_records`, also of a text PLY."""
    header = check_ply(path)
    vertex = header.elements[0] if header.elements else None
    if header.order or vertex is None or vertex.name != "vertex" or vertex.has_lists:
        return read_records(path)
    names = [entry.name for entry in vertex.properties]
    columns = read_columns(path, header, names)
    table = np.empty(vertex.rows, [(entry.name, entry.dtype) for entry in vertex.properties])
    for name, column in zip(names, columns.T if columns is not None else (), strict=True):
        table[name] = column
    return table, header.comments


def is_splat_ply(header: Header) -> bool:
    """Whether the vertices of a PLY are Gaussians, compressed ones included."""
    vertex = header.element("vertex")
    names = {entry.name for entry in vertex.properties} if vertex is not None else set()
    return {"opacity", "scale_0", "rot_0"} <= names or "packed_position" in names


class _Columns:
    """Named columns of a table as arrays."""

    def __init__(self, path: Path, table: np.ndarray) -> None:
        self.path, self.table, self.names = path, table, table.dtype.names or ()

    def count(self, prefix: str) -> int:
        return sum(name.startswith(prefix) for name in self.names)

    def read(self, names: list[str], dtype: type = np.float32) -> np.ndarray:
        """(N, K) of the named columns; InputError if one is missing."""
        missing = [name for name in names if name not in self.names]
        if missing:
            raise InputError(f"{self.path} is not a Gaussian splat PLY: property {missing[0]} is missing")
        return np.stack([self.table[name].astype(dtype) for name in names], 1)


def _refuse_compressed(path: Path) -> None:
    if path.is_file():
        with path.open("rb") as file:
            if file.read(2) == b"\x1f\x8b":  # gzip
                raise InputError(f"{path} is compressed (.spz?): save it as an uncompressed splat PLY")
    header = read_header(path)
    if header.element("chunk") is not None or is_splat_ply(header) and header.element("sh") is not None:
        raise InputError(
            f"{path} is a compressed splat PLY, as SuperSplat writes them: save it as an uncompressed PLY"
        )


def _log_scales(columns: _Columns) -> np.ndarray:
    """(N, 3); the third of flat Gaussians with two scales is small."""
    if columns.count("scale_") != 2:
        return columns.read(_numbered("scale", 3))
    scales = columns.read(_numbered("scale", 2))
    return np.column_stack([scales, scales.min(axis=1) + np.float32(np.log(FLAT))])


def _widen(arrays: dict[str, np.ndarray], width: np.ndarray) -> None:
    """Apply Mip-Splatting's 3D filter: the width (N, 1) is added to every scale, and opacity falls as volume
    grows.
    """
    squared = np.exp(2.0 * arrays["log_scales"].astype(np.float64))
    wider = squared + width.astype(np.float64) ** 2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        opacity = np.sqrt((squared / wider).prod(axis=1)) / (
            1 + np.exp(-arrays["opacity_logits"].astype(np.float64))
        )
        arrays["opacity_logits"] = np.log(opacity / (1 - opacity)).astype(np.float32)
        arrays["log_scales"] = (np.log(wider) / 2).astype(np.float32)


def _repair_turns(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Quaternions of length 0 are no rotation: taken as none at all."""
    none = ~arrays["quats"].any(axis=1)
    if none.any():
        logger.warning(
            "%s: %d Gaussians have no rotation (0 0 0 0) and are taken as not turned", path, none.sum()
        )
        arrays["quats"][none] = (1, 0, 0, 0)


def _doubt_activated(arrays: dict[str, np.ndarray], path: Path) -> None:
    scales, opacity = arrays["log_scales"], arrays["opacity_logits"]
    if len(scales) and (scales > 0).all() and ((opacity >= 0) & (opacity <= 1)).all():
        logger.warning(
            "%s: all scales are above 0 (median %.3g) and all opacities from 0 to 1: they look like plain values, but"
            " logarithms and logits are expected: save it as a 3DGS viewer wants it",
            path,
            float(np.median(scales)),
        )


def check_splats(arrays: Mapping[str, np.ndarray], origin: str | Path) -> None:
    """Raise InputError, which names `origin`, for values that cannot be rendered: not finite, or absurd;
    infinite opacities are possible.
    """
    for name, limit in LIMITS.items():
        values = arrays[name]
        sizes = values if name == "log_scales" else np.abs(values)
        if not (sizes <= limit).all() or (name != "opacity_logits" and not np.isfinite(values).all()):
            raise InputError(
                f"{origin} has Gaussians whose {name} are not finite, or beyond {limit:g}: train again, or remove them"
            )


def _numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{index}" for index in range(count)]


def _split(names: list[str], values: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[:, column] for column, name in enumerate(names)}
