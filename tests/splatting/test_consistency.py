"""Round trips through the depth of two views of a plane, where the right answer is known."""

import numpy as np
import torch

from sc3d.splatting import losses
from sc3d.splatting.consistency import consistent, pixel_rays, reprojection_error
from tests.splatting.test_losses import PLANE, camera, plane_depth


def test_rays_are_those_of_the_camera_module():
    view = camera(2, 1)
    points = (pixel_rays(view) * plane_depth(view)[..., None]).reshape(-1, 3).double().numpy()
    world = (points - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3]
    assert np.abs(world @ PLANE).max() < 1e-4


def test_plane_has_no_geometric_error():
    view, other = camera(2, 1), camera(-1, 2, 12, (80, 70), (100.0, 99.0, 41.0, 33.0))
    depth, other_depth = plane_depth(view), plane_depth(other)
    points_cam = (pixel_rays(view) * depth[..., None]).reshape(-1, 3)
    error, valid = reprojection_error(points_cam, view, other_depth, other)
    assert valid.float().mean() > 0.5
    assert error[valid].max() < 2e-3
    assert losses.geometric_loss(error, valid) < 1e-3


def test_wrong_depth_has_the_epipolar_error_and_useful_gradients():
    view, other = camera(2, 1), camera(-1, 2)
    depth = (plane_depth(view) * 1.01).requires_grad_()
    error, valid = reprojection_error(
        (pixel_rays(view) * depth[..., None]).reshape(-1, 3), view, plane_depth(other), other
    )
    assert 0.05 < error[valid].median() < 1
    losses.geometric_loss(error, valid).backward()
    assert torch.isfinite(depth.grad).all()
    assert (depth.grad[depth.grad != 0] > 0).float().mean() > 0.95  # all depths are too large


def test_depth_that_is_missing_is_not_compared():
    view, other = camera(2, 1), camera(-1, 2)
    other_depth = plane_depth(other)
    other_depth[:, :40] = 0
    depth = plane_depth(view)
    points_cam = (pixel_rays(view) * depth[..., None]).reshape(-1, 3)
    _, all_valid = reprojection_error(points_cam, view, plane_depth(other), other)
    error, valid = reprojection_error(points_cam, view, other_depth, other)
    assert 0.1 < valid.sum() / all_valid.sum() < 0.9
    assert error[valid].max() < 2e-3
    behind = pixel_rays(view).reshape(-1, 3) * -5.0
    assert not reprojection_error(behind, view, other_depth, camera(3, 0))[1].any()


def test_consistency_counts_views():
    view, others = camera(2, 1), [camera(-1, 2), camera(0, -1), camera(1, 3)]
    depth = plane_depth(view)
    depth[:5] = 0
    depth[30:40] *= 1.08
    maps = [(plane_depth(other), other) for other in others]
    maps[2] = (maps[2][0] * 0.9, others[2])
    others = [(other.numpy(), pose) for other, pose in maps]
    count, loose = consistent(depth.numpy(), view, others, 1.0, 1e3)
    assert np.array_equal(loose, consistent(depth.numpy(), view, others, 1e3)[0]) and (loose >= count).all()
    assert loose.max() == 3
    assert (count[:5] == 0).all() and (count[30:40] == 0).all()
    assert (count[15:25, 30:60] == 2).all() and count.max() == 2
