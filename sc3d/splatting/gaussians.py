"""The Gaussians themselves: parameters, initialization from sparse points, the 3DGS PLY."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import FARTHEST
from sc3d.io.ply import check_ply

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic Y_0."""

LARGEST_LOG = 40.0  # of a scale: beyond, its square is no float32
LARGEST_VALUE = 1e6  # of quaternions and harmonics


@dataclass
class Gaussians:
    """N Gaussians as raw (unconstrained) parameters, float32.

    means: (N, 3) centers, local world frame
    log_scales: (N, 3) natural log of the standard deviations, world units
    quats: (N, 4) wxyz rotations world_from_gaussian, not necessarily normalized
    opacity_logits: (N,)
    sh: (N, K, 3) spherical harmonics, K = 1, 4, 9, 16; color = 0.5 + sum_k Y_k(direction) sh_k; direction
        from the camera to the mean
    """

    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def from_points(
        cls, points: np.ndarray, colors: np.ndarray, sh_degree: int = 0, opacity: float = 0.1
    ) -> Gaussians:
        """One isotropic Gaussian per sparse point; its scale is the rms distance to the 3 nearest neighbors.

        Its first axis is the normal of the plane through the 12 nearest points: the axis along which training
        flattens it first.

        points: (N, 3) local world frame, N >= 2; colors: (N, 3) uint8 RGB; opacity: of every Gaussian, in (0,
            1)
        Duplicate and far points get a scale within 1/100 to 20 times the median. Raises InputError for fewer
        than two points.
        """
        points = np.asarray(points, np.float64)
        if len(points) < 2:
            raise InputError(
                f"training starts from the sparse points, and there are only {len(points)}: check the reconstruction"
            )
        distances, near = cKDTree(points).query(points, k=min(12, len(points)))
        scales = np.sqrt((distances[:, 1:4] ** 2).mean(1))
        median = np.median(scales[scales > 0]) if (scales > 0).any() else 1.0
        log_scales = (
            torch.from_numpy(np.log(np.clip(scales, 0.01 * median, 20 * median)))
            .float()[:, None]
            .repeat(1, 3)
        )
        sh = torch.zeros(len(points), (sh_degree + 1) ** 2, 3)
        sh[:, 0] = (torch.from_numpy(np.asarray(colors, np.float32)) / 255 - 0.5) / SH_C0
        quats = _first_axis_along(_plane_normals(points[near]))
        logits = torch.full((len(points),), float(np.log(opacity / (1 - opacity))))
        return cls(torch.from_numpy(points).float(), log_scales, quats, logits, sh)

    @property
    def sh_degree(self) -> int:
        """Degree of the stored harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def scales(self) -> torch.Tensor:
        """(N, 3) standard deviations along the Gaussian's own axes, world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> torch.Tensor:
        """(N,) in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def rotations(self) -> torch.Tensor:
        """(N, 3, 3) world_from_gaussian; the columns are the axes that `scales` belong to."""
        return rotations_from_quats(self.quats)

    @property
    def normals(self) -> torch.Tensor:
        """(N, 3) unit axis of the smallest scale, world; its sign means nothing."""
        smallest = self.log_scales.argmin(1)
        return self.rotations.gather(2, smallest[:, None, None].expand(-1, 3, 1))[..., 0]

    @property
    def covariances(self) -> torch.Tensor:
        """(N, 3, 3) R diag(scales^2) R^T, world units squared."""
        axes = self.rotations * self.scales[:, None, :]
        return axes @ axes.transpose(1, 2)

    def parameters(self) -> dict[str, torch.Tensor]:
        """The five tensors by name; not copies."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def detached(self) -> Gaussians:
        """The same values outside the autograd graph; memory is shared."""
        return Gaussians(**{name: tensor.detach() for name, tensor in self.parameters().items()})

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on another device."""
        return Gaussians(**{name: tensor.to(device) for name, tensor in self.parameters().items()})

    def __getitem__(self, chosen: torch.Tensor | np.ndarray) -> Gaussians:
        """The Gaussians of an index or bool tensor."""
        return Gaussians(**{name: tensor[chosen] for name, tensor in self.parameters().items()})

    def save(self, path: str | Path, comments: list[str] | None = None) -> None:
        """Write the PLY that 3DGS viewers read (binary, float32; positions stay in the local frame, so say
        its offset in a comment).

        nx ny nz hold `normals`; f_rest is ordered by color channel first.
        """
        with torch.no_grad():
            rest = self.sh[:, 1:].transpose(1, 2).reshape(len(self), -1)
            parts = [
                self.means,
                self.normals,
                self.sh[:, 0],
                rest,
                self.opacity_logits[:, None],
                self.log_scales,
                self.quats,
            ]
            values = torch.cat([part.detach().float() for part in parts], 1).numpy().astype("<f4")
        names = [
            *"xyz",
            "nx",
            "ny",
            "nz",
            *_numbered("f_dc", 3),
            *_numbered("f_rest", rest.shape[1]),
            "opacity",
            *_numbered("scale", 3),
            *_numbered("rot", 4),
        ]
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            *(f"comment {line}" for text in comments or [] for line in text.splitlines()),
            f"element vertex {len(self)}",
            *(f"property float {name}" for name in names),
            "end_header",
        ]
        with atomic_path(Path(path)) as temporary, open(temporary, "wb") as file:
            file.write(("\n".join(lines) + "\n").encode())
            file.write(np.ascontiguousarray(values).tobytes())

    @classmethod
    def load(cls, path: str | Path) -> tuple[Gaussians, list[str]]:
        """Read a 3DGS PLY; returns the Gaussians and the file's comment lines. Raises InputError if it is not
        one, or holds absurd values.
        """
        table, comments = _read_vertices(Path(path))

        def columns(names: list[str]) -> torch.Tensor:
            missing = [name for name in names if name not in table.dtype.names]
            if missing:
                raise InputError(f"{path} is not a Gaussian splat PLY: property {missing[0]} is missing")
            return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], 1))

        num_rest = sum(name.startswith("f_rest_") for name in table.dtype.names)
        if num_rest not in (0, 9, 24, 45):
            raise InputError(
                f"{path} has {num_rest} f_rest properties; 0, 9, 24 or 45 belong to degrees 0 to 3"
            )
        sh = columns(_numbered("f_dc", 3))[:, None]
        if num_rest:
            rest = columns(_numbered("f_rest", num_rest)).reshape(len(table), 3, num_rest // 3)
            sh = torch.cat([sh, rest.transpose(1, 2)], 1)
        gaussians = cls(
            columns(list("xyz")),
            columns(_numbered("scale", 3)),
            columns(_numbered("rot", 4)),
            columns(["opacity"])[:, 0],
            sh,
        )
        gaussians.check(path)
        return gaussians, comments

    def check(self, origin: str | Path) -> None:
        """Raise InputError, which names `origin`, for values that cannot be rendered: not finite, or absurd;
        infinite opacities are possible.
        """
        limits = {
            "means": FARTHEST,
            "log_scales": LARGEST_LOG,
            "quats": LARGEST_VALUE,
            "opacity_logits": float("inf"),
            "sh": LARGEST_VALUE,
        }
        for name, values in self.parameters().items():
            sizes = values if name == "log_scales" else values.abs()
            if not (sizes <= limits[name]).all() or (
                name != "opacity_logits" and not values.isfinite().all()
            ):
                raise InputError(
                    f"{origin} has Gaussians whose {name} are not finite, or beyond {limits[name]:g}: train again"
                )


def rotations_from_quats(quats: torch.Tensor) -> torch.Tensor:
    """(N, 3, 3) rotation matrices of (N, 4) wxyz quaternions of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def _plane_normals(groups: np.ndarray) -> np.ndarray:
    """(N, 3) unit normals of the planes through (N, K, 3) points; arbitrary sign."""
    centered = groups - groups.mean(1, keepdims=True)
    return np.linalg.eigh(centered.transpose(0, 2, 1) @ centered)[1][:, :, 0]


def _first_axis_along(directions: np.ndarray) -> torch.Tensor:
    """(N, 4) wxyz quaternions that turn (1, 0, 0) into the (N, 3) unit directions or their opposites, by at
    most 90 degrees.
    """
    directions = torch.from_numpy(np.where(directions[:, :1] < 0, -directions, directions)).float()
    x, y, z = directions.unbind(1)
    # Half-way rotation: w = 1 + cos(angle), vector = (1, 0, 0) x direction.
    return torch.nn.functional.normalize(torch.stack([1 + x, torch.zeros_like(x), -z, y], 1), dim=1)


def _numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{index}" for index in range(count)]


def _read_vertices(path: Path) -> tuple[np.ndarray, list[str]]:
    """Structured (N,) table of the element "vertex", which comes first, and the comments."""
    if not path.is_file():
        raise InputError(f"{path} does not exist")
    header = check_ply(path)
    if header.order != "<":
        raise InputError(f"{path} is not a binary little endian PLY")
    vertex = header.elements[0] if header.elements else None
    if vertex is None or vertex.name != "vertex" or vertex.has_lists:
        raise InputError(f"{path} does not start with an element named vertex, without lists")
    dtype = np.dtype([(entry.name, header.order + entry.dtype) for entry in vertex.properties])
    return np.fromfile(path, dtype, vertex.rows, offset=header.size), list(header.comments)
