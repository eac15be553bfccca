"""The header of LAS and LAZ, as laspy has it."""

import laspy
import numpy as np
import pytest

from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.las import check_las

FORMS = [(form, ".las") for form in range(11)] + [(form, ".laz") for form in (0, 1, 2, 3, 6, 7, 8)]


@pytest.mark.parametrize(("form", "suffix"), FORMS)  # lazrs writes no wave packets
def test_count_and_colors_are_those_of_laspy(tmp_path, form, suffix):
    header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.3" if form > 3 else "1.2")
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(25.0)
    las.write(tmp_path / f"a{suffix}")
    found, has_colors = check_las(tmp_path / f"a{suffix}"), "red" in las.point_format.dimension_names
    assert found.num_points == 25 and found.has_colors == has_colors
    cloud = CloudFile.open(tmp_path / f"a{suffix}")
    assert cloud.num_points == 25 and ("red" in cloud.dtype.names) == has_colors
    assert [records["x"].tolist() for _, records in cloud.chunks()] == [list(range(25))]
