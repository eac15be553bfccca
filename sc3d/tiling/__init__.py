"""Clouds larger than memory, tile by tile: the same results as in one piece, whatever the number of tiles and
of workers.

    files     clouds and meshes in chunks, as tables of records
    store     the points of a cloud by tile; a tile is read with a margin of its neighbors' points
    tasks     where the work of each tile runs: here, or on Dask workers
    ranges    first surface of each view, the nearest over all parts of a mesh
    label, propagate, evaluate    the stages

Whatever is summed over tiles is an integer, so that no order matters.
"""
