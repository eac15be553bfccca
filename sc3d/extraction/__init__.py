"""Depth of all views to one surface: what views confirm is fused, what only goes on is added and counted."""
