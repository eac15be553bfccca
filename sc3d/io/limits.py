"""How files are built: counts and sizes are compared with what is there before a native library, which may
crash or fill the memory, reads them.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass

FARTHEST = 1e10  # world units from the origin: float64 has no millimeters beyond
# the largest cameras of drones have 151 megapixels; what a few bytes can announce must fit into the memory
MAX_PIXELS = 160_000_000
MAX_SIDE = 100_000
