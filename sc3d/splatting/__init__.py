"""Planar Gaussians: rendering, losses, densification, training. The only home of torch besides segmentation."""
