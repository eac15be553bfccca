"""Masks made by other programs: COCO, LabelMe, CVAT, PNGs in colours or ids; one file per format, and the
rules they share.
"""
