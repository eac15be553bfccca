"""Masks to labels on the cloud (paper sections 3.3 and 4.3)."""
