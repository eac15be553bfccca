"""What photos, positions, cameras and masks are worth, before hours of work: small pictures, seconds."""
