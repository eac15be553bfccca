"""Which points of a cloud in tiles hang together: groups within each tile, and the links between them."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from sc3d.tiling.executor import Executor
from sc3d.tiling.tile_graph import PropagateJob, TileGraph


def reached_groups(job: PropagateJob, executor: Executor) -> dict[int, np.ndarray]:
    """Per tile, (K,) bool: the connected groups of its points from which some path, through whatever tiles,
    leads to a seed.
    """
    tiles = job.store.tiles
    sizes = np.cumsum([0, *executor.run("connections", partial(_component_task, job), tiles)])
    first = dict(zip(tiles, sizes[:-1].tolist(), strict=True))
    found = executor.run("links", partial(_link_task, job, first), tiles)
    links = np.concatenate([pairs for pairs, _ in found])
    graph = coo_matrix((np.ones(len(links), np.int8), links.T), shape=(sizes[-1], sizes[-1]))
    group, seeded = connected_components(graph, directed=False)[1], np.zeros(sizes[-1], bool)
    seeded[np.concatenate([with_seed for _, with_seed in found])] = True
    reached = np.bincount(group, seeded)[group] > 0
    return {
        tile: reached[first[tile] : first[tile] + size]
        for tile, size in zip(tiles, np.diff(sizes), strict=True)
    }


def _component_task(job: PropagateJob, tile: int) -> int:
    """Number the connected groups of a part's points over the edges of the tile's own points; returns how
    many there are.
    """
    part = TileGraph.load(job, tile)
    graph, count = part.graph, len(part.core)
    rows = np.repeat(part.core, np.diff(graph.starts))
    starts = np.append(0, np.cumsum(np.where(part.core, np.diff(graph.starts), 0)))
    edges = csr_matrix(
        (np.ones(int(rows.sum()), np.int8), graph.neighbors[rows], starts), shape=(count, count)
    )
    number, group = connected_components(edges, directed=False)
    job.results.write(tile, group=part.own(group.astype(np.int32)), all_groups=group.astype(np.int32))
    return number


def _link_task(job: PropagateJob, first: dict[int, int], tile: int) -> tuple[np.ndarray, np.ndarray]:
    """(L, 2) pairs of groups, numbered over all tiles, that share a point, and (S,) groups of the tile that
    hold a seed.
    """
    part = TileGraph.load(job, tile)
    mine = job.results.read(tile, "all_groups").astype(np.int64) + first[tile]
    others = part.halo.gather(
        lambda other: job.results.read(other, "group", mapped=True).astype(np.int64) + first[other]
    )[part.graph.order]
    pairs = np.unique(np.stack([mine[~part.core], others[~part.core]], axis=1), axis=0)
    return pairs, np.unique(mine[part.core & (part.known.seed_labels > 0)])
