"""Objects of countable classes: which points are one building, one tree, one car."""
