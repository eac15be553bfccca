"""Clouds larger than memory, tile by tile: the same results as in one piece, whatever the number of tiles and of workers.

    executor       where the work of each tile runs: in this process, in others of this machine (worker_pool), or on a Dask cluster
    memory         what fits, and how large a tile may be
    work_folder    where finished parts wait, so that a killed run goes on
    store          the points of a cloud by tile; a tile is read with a halo of its neighbors' points
    first_surfaces first surface of each view, the nearest over all parts of a mesh
    label, propagate (on the graphs of tile_graph), evaluate    the stages; label_grid_file writes the field of all tiles

Whatever is summed over tiles is an integer, so that no order matters.
"""
