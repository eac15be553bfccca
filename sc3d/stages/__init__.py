"""The stages: each names its input and output files and leaves the method to the packages below."""
