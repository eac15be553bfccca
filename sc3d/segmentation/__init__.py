"""Photos to 2D masks: one file per backend, and the rules they share."""
