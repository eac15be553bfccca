"""The header of LAS and LAZ, as laspy has it."""

import laspy
import numpy as np
import pytest

from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.las import check_las


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("form", range(11))
def test_count_and_colors_are_those_of_laspy(tmp_path, form, suffix):
    if form in (4, 5, 9, 10) and suffix == ".laz":
        pytest.skip("lazrs does not write wave packets")
    header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.3" if form > 3 else "1.2")
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(25.0)
    las.write(tmp_path / f"a{suffix}")
    found, has_colors = check_las(tmp_path / f"a{suffix}"), "red" in las.point_format.dimension_names
    assert found.count == 25 and found.has_colors == has_colors
    cloud = CloudFile.open(tmp_path / f"a{suffix}")
    assert cloud.num_points == 25 and ("red" in cloud.dtype.names) == has_colors
    assert [records["x"].tolist() for _, records in cloud.chunks()] == [list(range(25))]
