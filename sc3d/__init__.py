"""Drone photos to a semantically labelled 3D reconstruction."""

import os

from sc3d.io.caches import provide_caches

__version__ = "0.1.0"

# Read when torch and numba load, so they are set here, before either does; the user's own values win.
# Idle OpenMP threads of torch would spin and starve the kernels:
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Numba's own order warns about every older TBB
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
provide_caches()
