"""Masks made by other programs: COCO, LabelMe, CVAT, PNGs in colors or ids; one file per format, and the
rules they share.
"""
