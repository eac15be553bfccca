"""What a file may announce at most. Counts and sizes are compared with what is there before a native library,
which may crash or fill the memory, reads them.
"""

FARTHEST = 1e10  # world units from the origin: float64 has no millimeters beyond
# of a photo: the largest cameras of drones have 151 megapixels; what a few bytes can announce must fit into
# the memory
MAX_PIXELS = 160_000_000
MAX_SIDE = 100_000  # px
MAX_MASK_PIXELS = 100_000_000  # of a mask that is larger than its photo: sharper masks are of no use

# bytes; of a file that is larger, at least the share HOLLOW must be on the disk: a few bytes can announce any
# size, whose nothing would be read for hours. Disks that compress keep more of what sc3d reads
SOLID, HOLLOW = 1 << 30, 0.01


class DamagedFileError(ValueError):
    """Says what is wrong in words that complete "<file>"; who knows the file makes an InputError of it."""
