"""The objects that a segmenter found in a photo, as a picture of their numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np


class ObjectImage(NamedTuple):
    """The objects of a photo. numbers: (H, W) int32 number of the best object at each pixel, 0 = none;
    class_ids: (K + 1,) uint8 of each number, 0 first
    """

    numbers: np.ndarray
    class_ids: np.ndarray


ReadObjects = Callable[[Path], ObjectImage]  # of a file in `instances/`, in the frame of the photo as shown
