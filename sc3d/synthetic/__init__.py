"""A synthetic aerial site: known geometry, cameras and labels, photographed as by a drone."""
