"""A cloud in parts, for what does not fit into memory: records of a file as a cloud, and an even selection of the
points.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.io.chunked_clouds import CloudFile, columns, positions
from sc3d.io.colors import COLORS

logger = logging.getLogger(__name__)

NORMALS = ("nx", "ny", "nz")
GROUPS = {"normals": NORMALS, "colors": tuple(COLORS)}


def cloud_of(records: np.ndarray) -> o3d.t.geometry.PointCloud:
    """A cloud of the (N,) records of a `CloudFile`, with all their fields as attributes, as `read_cloud` has
    them.
    """
    cloud, names = o3d.t.geometry.PointCloud(positions(records)), set(records.dtype.names or ()) - set("xyz")
    for attribute, group in GROUPS.items():
        values = columns(records, group)
        if values is not None:
            cloud.point[attribute] = o3d.core.Tensor(np.ascontiguousarray(values))
            names -= set(group)
    for name in sorted(names):
        kind = records.dtype[name].newbyteorder("=")
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(records[name], kind)[:, None])
    return cloud


def records_of(cloud: o3d.t.geometry.PointCloud) -> np.ndarray:
    """(N,) records of a cloud, in the order in which `write_geometry` has them: positions, normals and colors,
    then what else there is.
    """
    table: dict[str, np.ndarray] = dict(zip("xyz", cloud.point.positions.numpy().T, strict=True))
    for attribute, group in GROUPS.items():
        if attribute in cloud.point:
            table |= dict(zip(group, cloud.point[attribute].numpy().T, strict=True))
    others = sorted(set(cloud.point) - {"positions", *GROUPS})
    table |= {name: cloud.point[name].numpy().reshape(-1) for name in others}
    records = np.empty(len(cloud.point.positions), [(name, values.dtype) for name, values in table.items()])
    for name, values in table.items():
        records[name] = values
    return records


def read_thinned(path: Path, count: int) -> o3d.t.geometry.PointCloud:
    """About `count` points of a cloud, evenly from all of it and in its order; the same in each call."""
    file, random = CloudFile.open(path), np.random.default_rng(0)
    share = min(1.0, count / file.num_points)
    chosen = [records[random.random(len(records)) < share] for _, records in file.chunks()]
    return cloud_of(np.concatenate(chosen))
