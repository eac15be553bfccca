"""The rasterizer on the CPU, in numba: projection, tiles, compositing, and their backward passes."""
