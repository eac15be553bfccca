"""Where a scene lies on Earth: GPS of the photos, ground control points, coordinate reference systems."""
