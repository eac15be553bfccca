"""Gaussians as SPZ: a tenth of the PLY's size, for the web; splats of chosen classes, as the format has no
room for labels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.exporters import splats
from sc3d.exporters.projected_cloud import chosen_classes, find_projection
from sc3d.io.atomic import atomic_path
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.splatting.gaussians import Gaussians
from sc3d.view.display_splats import read_splats


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "splats.spz"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/splats.spz` (version 4), axes and origin as in splats.ply; with `--classes` of these only.

    What the format keeps: positions to 1/8192 of a unit, logs of scales to 1/32 from -10 on, opacity to
    1/510, f_dc to 1/76 between -3.3 and 3.3, f_rest to 1/32 (first degree) and 1/16 between -1 and 1.
    """
    chosen, projection = chosen_classes(scene, settings), find_projection(scene, settings)
    if "splats" in settings.format[: settings.format.index("spz")]:  # written by the same command
        labelled = read_splats(scene.labelled_splats, scene.class_table())
    else:
        labelled = splats.label_splats(scene, settings).only(chosen)
    path = outputs(scene, settings)[0]
    with atomic_path(path) as temporary:
        if not o3d.t.io.write_point_cloud(str(temporary), splat_cloud(labelled.gaussians)):
            raise OSError(f"could not write {path}: is the disk full?")
    return splats.figures(labelled, projection)


def splat_cloud(gaussians: Gaussians) -> o3d.t.geometry.PointCloud:
    """Gaussians with the attributes that Open3D gives to splats: `scale` is not logarithmic, `opacity` is a
    logit, `rot` is wxyz of length 1.
    """
    lengths = gaussians.quats.norm(dim=1, keepdim=True)
    parts = {
        "positions": gaussians.means,
        "f_dc": gaussians.sh_dc,
        "opacity": gaussians.opacity_logits[:, None],
        "scale": gaussians.scales,
        "rot": gaussians.quats / lengths.clamp_min(1e-12),
    }
    if gaussians.sh_degree:
        parts["f_rest"] = gaussians.sh_rest
    cloud = o3d.t.geometry.PointCloud()
    for name, values in parts.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values.detach().numpy(), np.float32))
    return cloud
