"""Measurements behind `sc3d benchmark`: how fast training is, how good the surface, the tables of the paper."""
