"""Planar Gaussians: rendering, losses, densification, training. The home of torch beside segmentation."""
