"""A page in the browser on which the user marks a few strokes per class; served to this machine only."""
