"""The 3DGS PLY: exact, as other programs read it, and refused where it is damaged."""

import numpy as np
import open3d as o3d
import pytest
import torch

from sc3d.errors import InputError
from sc3d.io.splats import read_splat_ply, write_splat_ply
from sc3d.splatting.gaussians import Gaussians
from tests.splatting.test_gaussians import random_gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip_is_exact(tmp_path, degree):
    gaussians = random_gaussians(17, degree)
    write_splat_ply(tmp_path / "a.ply", gaussians.arrays(), ["offset 431000 4582000 12", "made by sc3d"])
    arrays, comments = read_splat_ply(tmp_path / "a.ply")
    loaded = Gaussians.from_arrays(arrays)
    for name, tensor in gaussians.parameters().items():
        assert torch.equal(tensor, loaded.parameters()[name]), name
    assert comments == ["offset 431000 4582000 12", "made by sc3d"]
    assert loaded.sh_degree == degree
    assert [file.name for file in tmp_path.iterdir()] == ["a.ply"]


def test_open3d_reads_the_same_values(tmp_path):
    gaussians = random_gaussians(9, 3)
    write_splat_ply(tmp_path / "a.ply", gaussians.arrays())
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "a.ply"))
    read = {name: cloud.point[name].numpy() for name in cloud.point}
    assert np.array_equal(read["positions"], gaussians.means.numpy())
    assert np.array_equal(read["opacity"].ravel(), gaussians.opacity_logits.numpy())
    assert np.array_equal(read["f_dc"], gaussians.sh_dc.numpy())
    assert np.allclose(read["scale"], gaussians.scales.numpy(), rtol=1e-6)  # Open3D stores the exponential
    assert np.array_equal(read["rot"], gaussians.quats.numpy())
    assert np.array_equal(read["f_rest"], gaussians.sh_rest.numpy())


def test_higher_harmonics_are_ordered_by_channel(tmp_path):
    gaussians = random_gaussians(4, 2)
    write_splat_ply(tmp_path / "a.ply", gaussians.arrays())
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property")]
    table = np.frombuffer(body, "<f4").reshape(4, len(names))
    assert names[:6] == ["x", "y", "z", "nx", "ny", "nz"] and names[-4:] == [
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    for channel in range(3):
        for k in range(1, 9):
            column = names.index(f"f_rest_{channel * 8 + k - 1}")
            assert np.array_equal(table[:, column], gaussians.sh_rest[:, k - 1, channel].numpy())


def test_other_files_are_refused_with_a_reason(tmp_path):
    (tmp_path / "text.ply").write_text("hello\n")
    with pytest.raises(InputError, match="not a PLY"):
        read_splat_ply(tmp_path / "text.ply")
    with pytest.raises(InputError, match="is missing"):
        read_splat_ply(tmp_path / "missing.ply")
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.eye(3, dtype=np.float32)))
    o3d.t.io.write_point_cloud(str(tmp_path / "cloud.ply"), cloud)
    with pytest.raises(InputError, match="not a Gaussian splat"):
        read_splat_ply(tmp_path / "cloud.ply")
    write_splat_ply(tmp_path / "short.ply", random_gaussians(5, 0).arrays())
    (tmp_path / "short.ply").write_bytes((tmp_path / "short.ply").read_bytes()[:-7])
    with pytest.raises(InputError, match="truncated"):
        read_splat_ply(tmp_path / "short.ply")
