"""Complete the labels along the geometry (paper section 3.4)."""
