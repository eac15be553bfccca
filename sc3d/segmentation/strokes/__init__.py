"""Masks from a few strokes: a pixel classifier on color and texture."""
