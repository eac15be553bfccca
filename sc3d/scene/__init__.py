"""The scene folder: its files, class table, cameras, labels and labelled clouds."""
