"""How files are built: counts and sizes are compared with what is there before a native library, which may crash or fill the memory, reads them."""

FARTHEST = 1e10  # world units from the origin: float64 has no millimetres beyond
