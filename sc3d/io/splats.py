"""Gaussians in the PLY that 3DGS viewers read, as plain arrays.

Columns: x y z, nx ny nz, f_dc (3), f_rest (0, 9, 24 or 45, color channel by color channel), opacity (a
logit), scale (3 logarithms), rot (wxyz).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.limits import FARTHEST
from sc3d.io.ply import read_records, write_records

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


def origin_comment(origin: np.ndarray) -> str:
    """The comment that says where the origin of the local frame, (3,) world, lies."""
    return f"sc3d origin {origin[0]:.3f} {origin[1]:.3f} {origin[2]:.3f}"


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


def read_splat_ply(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read a 3DGS PLY.

    returns: float32 arrays means (N, 3), local frame; log_scales (N, 3); quats (N, 4) wxyz of any length;
        opacity_logits (N,); sh_dc (N, 3); sh_rest (N, K - 1, 3), K = 1, 4, 9, 16; and the comment lines
    Raises InputError for another file, and for values that cannot be rendered.
    """
    table, comments = read_records(path)
    known = set(table.dtype.names or ())

    def columns(names: list[str]) -> np.ndarray:
        missing = [name for name in names if name not in known]
        if missing:
            raise InputError(f"{path} is not a Gaussian splat PLY: property {missing[0]} is missing")
        return np.stack([table[name].astype(np.float32) for name in names], 1)

    num_rest = sum(name.startswith("f_rest_") for name in known)
    if num_rest not in (0, 9, 24, 45):
        raise InputError(f"{path} has {num_rest} f_rest properties; 0, 9, 24 or 45 belong to degrees 0 to 3")
    arrays = {
        "means": columns(list("xyz")),
        "log_scales": columns(_numbered("scale", 3)),
        "quats": columns(_numbered("rot", 4)),
        "opacity_logits": columns(["opacity"])[:, 0],
        "sh_dc": columns(_numbered("f_dc", 3)),
        "sh_rest": np.zeros((len(table), 0, 3), np.float32),
    }
    if num_rest:
        rest = columns(_numbered("f_rest", num_rest)).reshape(len(table), 3, num_rest // 3)
        arrays["sh_rest"] = np.ascontiguousarray(rest.transpose(0, 2, 1))
    check_splats(arrays, path)
    return arrays, list(comments)


def check_splats(arrays: Mapping[str, np.ndarray], origin: str | Path) -> None:
    """Raise InputError, which names `origin`, for values that cannot be rendered: not finite, or absurd;
    infinite opacities are possible.
    """
    for name, limit in LIMITS.items():
        values = arrays[name]
        sizes = values if name == "log_scales" else np.abs(values)
        if not (sizes <= limit).all() or (name != "opacity_logits" and not np.isfinite(values).all()):
            raise InputError(
                f"{origin} has Gaussians whose {name} are not finite, or beyond {limit:g}: train again"
            )


def _numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{index}" for index in range(count)]


def _split(names: list[str], values: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[:, column] for column, name in enumerate(names)}
