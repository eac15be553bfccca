"""The scene folder: its files, class table, cameras, labels and labelled clouds."""

from sc3d.scene.scene import Scene as Scene
