"""The normals that a cloud on disk has of its own."""

from __future__ import annotations

import logging

from sc3d.io.chunked_clouds import CloudFile, columns
from sc3d.scene.labelled_cloud import usable_normals

NORMALS = ("nx", "ny", "nz")

logger = logging.getLogger(__name__)


def has_usable_normals(cloud: CloudFile) -> bool:
    """Whether all points have normals with a direction; a line if only some have, as `labelled_cloud.unit_normals`
    says it of a cloud in memory.
    """
    if not set(NORMALS) <= set(cloud.names):
        return False
    unusable = 0
    for _, records in cloud.chunks():
        normals = columns(records, NORMALS)
        unusable += 0 if normals is None else int((~usable_normals(normals)).sum())
    if unusable:
        logger.warning(
            "%s: %d of %d normals have no length or are not finite: all are estimated",
            cloud.path,
            unusable,
            cloud.num_points,
        )
    return not unusable
