"""Classes by shape, height above the ground and color of a cloud, without masks and without a model."""
