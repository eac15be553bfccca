"""Geometry on arrays and Open3D tensors; knows nothing of classes and stands alone."""
