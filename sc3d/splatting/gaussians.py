"""The Gaussians themselves: parameters, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.errors import InputError

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic Y_0."""

FLAT = 0.1  # thickness of a Gaussian on a known surface, relative to its width
KNOWN = 0.5  # its opacity at the start


@dataclass
class Gaussians:
    """N Gaussians as raw (unconstrained) parameters, float32.

    means: (N, 3) centers, local world frame
    log_scales: (N, 3) natural log of the standard deviations, world units
    quats: (N, 4) wxyz rotations world_from_gaussian, not necessarily normalized
    opacity_logits: (N,)
    sh_dc: (N, 3) spherical harmonic Y_0 of each color channel
    sh_rest: (N, K - 1, 3) the others, K = 1, 4, 9, 16; none unless given
    color = 0.5 + Y_0 sh_dc + sum_k Y_k(direction) sh_rest_k, direction from the camera to the mean
    """

    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    opacity_logits: torch.Tensor
    sh_dc: torch.Tensor
    sh_rest: torch.Tensor = field(default_factory=lambda: torch.zeros(0, 0, 3))

    def __post_init__(self) -> None:
        if len(self.sh_rest) < len(self.sh_dc):
            self.sh_rest = self.sh_dc.new_zeros(len(self.sh_dc), 0, 3)

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def from_points(
        cls,
        points: np.ndarray,
        colors: np.ndarray,
        sh_degree: int = 0,
        opacity: float = 0.1,
        normals: np.ndarray | None = None,
    ) -> Gaussians:
        """One isotropic Gaussian per sparse point; its scale is the rms distance to the 3 nearest neighbors.

        Its first axis is the normal of the plane through the 12 nearest points: the axis along which training
        flattens it first.

        points: (N, 3) local world frame, N >= 2; colors: (N, 3) uint8 RGB; opacity: of all, in (0, 1)
        normals: (N, 3) of surfaces that are known, 0 = unknown: those become flat discs of opacity KNOWN
        Duplicate and far points get a scale within 1/100 to 20 times the median. Raises InputError for fewer
        than two points.
        """
        points = np.asarray(points, np.float64)
        size = len(points)
        if size < 2:
            raise InputError(
                f"training starts from the sparse points, and there are only {size}: check the reconstruction"
            )
        distances, near = cKDTree(points).query(points, k=min(12, size))
        scales = np.sqrt((distances[:, 1:4] ** 2).mean(1))
        median = np.median(scales[scales > 0]) if (scales > 0).any() else 1.0
        log_scales = torch.from_numpy(np.log(np.clip(scales, 0.01 * median, 20 * median))).float()
        log_scales = log_scales[:, None].repeat(1, 3)
        axes, logits = (
            _plane_normals(points[near]),
            torch.full((size,), float(np.log(opacity / (1 - opacity)))),
        )
        if normals is not None:
            length = np.linalg.norm(normals, axis=1)
            known = length > 0.5
            axes[known] = normals[known] / length[known, None]
            log_scales[torch.from_numpy(known), 0] += float(np.log(FLAT))
            logits[torch.from_numpy(known)] = float(np.log(KNOWN / (1 - KNOWN)))
        return cls(
            torch.from_numpy(points).float(),
            log_scales,
            _first_axis_along(axes),
            logits,
            (torch.from_numpy(np.asarray(colors, np.float32)) / 255 - 0.5) / SH_C0,
            torch.zeros(size, (sh_degree + 1) ** 2 - 1, 3),
        )

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Gaussians:
        """From float32 arrays named like the fields, as `io.splats` reads them; memory is shared."""
        return cls(**{field.name: torch.from_numpy(arrays[field.name]) for field in fields(cls)})

    def arrays(self) -> dict[str, np.ndarray]:
        """What `from_arrays` takes, and "normals" (N, 3), as `io.splats` writes them."""
        tensors = self.detached().to("cpu")
        return {
            name: values.numpy()
            for name, values in {**tensors.parameters(), "normals": tensors.normals}.items()
        }

    @property
    def sh(self) -> torch.Tensor:
        """(N, K, 3) all spherical harmonics; a copy."""
        return torch.cat([self.sh_dc[:, None], self.sh_rest], 1)

    @property
    def sh_degree(self) -> int:
        """Degree of the stored harmonics, 0 to 3."""
        return round((self.sh_rest.shape[1] + 1) ** 0.5) - 1

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
        w, x, y, z = torch.nn.functional.normalize(self.quats, dim=1).unbind(1)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return torch.stack([torch.stack(row, 1) for row in rows], 1)

    @property
    def normals(self) -> torch.Tensor:
        """(N, 3) unit axis of the smallest scale, world; its sign means nothing."""
        smallest = self.log_scales.argmin(1)
        return self.rotations.gather(2, smallest[:, None, None].expand(-1, 3, 1))[..., 0]

    @property
    def base_colors(self) -> np.ndarray:
        """(N, 3) uint8 RGB: the mean color over all directions of view."""
        colors = 0.5 + SH_C0 * self.sh_dc.detach().cpu().numpy()
        return np.round(np.clip(colors, 0, 1) * 255).astype(np.uint8)

    @property
    def covariances(self) -> torch.Tensor:
        """(N, 3, 3) R diag(scales^2) R^T, world units squared."""
        axes = self.rotations * self.scales[:, None, :]
        return axes @ axes.transpose(1, 2)

    def parameters(self) -> dict[str, torch.Tensor]:
        """The six tensors by name; not copies."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def detached(self) -> Gaussians:
        """The same values outside the autograd graph; memory is shared."""
        return Gaussians(**{name: tensor.detach() for name, tensor in self.parameters().items()})

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on another device."""
        return Gaussians(**{name: tensor.to(device) for name, tensor in self.parameters().items()})

    def painted(self, colors: np.ndarray) -> Gaussians:
        """The same Gaussians in one color each from everywhere. colors: (N, 3) RGB, 0 to 1; float32"""
        values = torch.from_numpy(np.ascontiguousarray(colors, np.float32)).to(self.means)
        return Gaussians(self.means, self.log_scales, self.quats, self.opacity_logits, (values - 0.5) / SH_C0)

    def __getitem__(self, chosen: torch.Tensor | np.ndarray | slice) -> Gaussians:
        """The Gaussians of an index or bool tensor, or a slice."""
        return Gaussians(**{name: tensor[chosen] for name, tensor in self.parameters().items()})


def _plane_normals(groups: np.ndarray) -> np.ndarray:
    """(N, 3) unit normals of the planes through (N, K, 3) points; arbitrary sign."""
    centered = groups - groups.mean(1, keepdims=True)
    return np.linalg.eigh(centered.transpose(0, 2, 1) @ centered)[1][:, :, 0]


def _first_axis_along(directions: np.ndarray) -> torch.Tensor:
    """(N, 4) wxyz quaternions that turn (1, 0, 0) into the (N, 3) unit directions or their opposites, by at
    most 90 degrees.
    """
    x, y, z = torch.from_numpy(np.where(directions[:, :1] < 0, -directions, directions)).float().unbind(1)
    # Half-way rotation: w = 1 + cos(angle), vector = (1, 0, 0) x direction.
    return torch.nn.functional.normalize(torch.stack([1 + x, torch.zeros_like(x), -z, y], 1), dim=1)
