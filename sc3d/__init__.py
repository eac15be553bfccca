"""Drone photos to a semantically labelled 3D reconstruction."""

__version__ = "0.1.0"
