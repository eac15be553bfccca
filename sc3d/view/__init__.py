"""Looking at a scene: colors, pictures without a display, labels in the photos, the window, the browser."""
