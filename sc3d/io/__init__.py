"""Files in and out: checked on the way in, written to a temporary name and renamed on the way out."""
