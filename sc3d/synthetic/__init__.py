"""A synthetic site or street: known geometry, cameras and labels, photographed as by a drone or on foot."""
