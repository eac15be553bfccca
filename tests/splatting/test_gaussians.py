"""Gaussians: initialization, accessors, the 3DGS PLY."""

import numpy as np
import open3d as o3d
import pytest
import torch

from sc3d.errors import InputError
from sc3d.splatting.gaussians import SH_C0, Gaussians


def random_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, (degree + 1) ** 2, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def test_scale_is_the_rms_distance_to_three_neighbors():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [100, 100, 100]], float)
    gaussians = Gaussians.from_points(points, np.full((5, 3), 128, np.uint8), sh_degree=1)
    assert gaussians.scales[0].numpy() == pytest.approx(np.full(3, np.sqrt((1 + 4 + 9) / 3)), rel=1e-6)
    assert gaussians.opacities.numpy() == pytest.approx(np.full(5, 0.1), rel=1e-5)
    assert gaussians.sh.shape == (5, 4, 3) and not gaussians.sh[:, 1:].any()
    assert (0.5 + SH_C0 * gaussians.sh[:, 0]).numpy() == pytest.approx(np.full((5, 3), 128 / 255), rel=1e-6)


def test_duplicate_points_get_a_finite_scale():
    points = np.concatenate([np.zeros((6, 3)), np.random.default_rng(0).random((50, 3))])
    assert torch.isfinite(Gaussians.from_points(points, np.zeros((56, 3), np.uint8)).log_scales).all()
    assert torch.isfinite(
        Gaussians.from_points(np.zeros((9, 3)), np.zeros((9, 3), np.uint8)).log_scales
    ).all()
    assert len(Gaussians.from_points(np.eye(3)[:2], np.zeros((2, 3), np.uint8))) == 2
    with pytest.raises(InputError, match="sparse points"):
        Gaussians.from_points(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))


def test_first_axis_starts_along_the_surface_normal():
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    points[:, 2] = 0.3 * points[:, 0] - 0.8 * points[:, 1]
    gaussians = Gaussians.from_points(points, np.zeros((300, 3), np.uint8))
    normal = np.array([0.3, -0.8, -1]) / np.linalg.norm([0.3, -0.8, -1])
    assert np.abs(gaussians.rotations[:, :, 0].numpy() @ normal).min() > 0.9999
    assert np.abs(gaussians.normals.numpy() @ normal).min() > 0.9999  # of equal scales the first counts


def test_normals_are_the_thin_axis_of_the_covariance():
    gaussians = random_gaussians(50, 0)
    values, vectors = torch.linalg.eigh(gaussians.covariances.double())
    assert torch.allclose(values.sqrt().float(), gaussians.scales.sort(1).values, rtol=1e-2)
    assert ((vectors[:, :, 0].float() * gaussians.normals).sum(1).abs() > 0.999).all()
    assert torch.allclose(torch.linalg.det(gaussians.rotations), torch.ones(50), atol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip_is_exact(tmp_path, degree):
    gaussians = random_gaussians(17, degree)
    gaussians.save(tmp_path / "a.ply", ["offset 431000 4582000 12", "made by sc3d"])
    loaded, comments = Gaussians.load(tmp_path / "a.ply")
    for name, tensor in gaussians.parameters().items():
        assert torch.equal(tensor, loaded.parameters()[name]), name
    assert comments == ["offset 431000 4582000 12", "made by sc3d"]
    assert loaded.sh_degree == degree
    assert [file.name for file in tmp_path.iterdir()] == ["a.ply"]


def test_open3d_reads_the_same_values(tmp_path):
    gaussians = random_gaussians(9, 3)
    gaussians.save(tmp_path / "a.ply")
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "a.ply"))
    read = {name: cloud.point[name].numpy() for name in cloud.point}
    assert np.array_equal(read["positions"], gaussians.means.numpy())
    assert np.array_equal(read["opacity"].ravel(), gaussians.opacity_logits.numpy())
    assert np.array_equal(read["f_dc"], gaussians.sh[:, 0].numpy())
    assert np.allclose(read["scale"], gaussians.scales.numpy(), rtol=1e-6)  # Open3D stores the exponential
    assert np.array_equal(read["rot"], gaussians.quats.numpy())
    assert np.array_equal(read["f_rest"], gaussians.sh[:, 1:].numpy())


def test_higher_harmonics_are_ordered_by_channel(tmp_path):
    gaussians = random_gaussians(4, 2)
    gaussians.save(tmp_path / "a.ply")
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
            assert np.array_equal(table[:, column], gaussians.sh[:, k, channel].numpy())


def test_other_files_are_refused_with_a_reason(tmp_path):
    (tmp_path / "text.ply").write_text("hello\n")
    with pytest.raises(InputError, match="not a PLY"):
        Gaussians.load(tmp_path / "text.ply")
    with pytest.raises(InputError, match="does not exist"):
        Gaussians.load(tmp_path / "missing.ply")
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.eye(3, dtype=np.float32)))
    o3d.t.io.write_point_cloud(str(tmp_path / "cloud.ply"), cloud)
    with pytest.raises(InputError, match="not a Gaussian splat"):
        Gaussians.load(tmp_path / "cloud.ply")
    random_gaussians(5, 0).save(tmp_path / "short.ply")
    (tmp_path / "short.ply").write_bytes((tmp_path / "short.ply").read_bytes()[:-7])
    with pytest.raises(InputError, match="truncated"):
        Gaussians.load(tmp_path / "short.ply")
