"""The stages: each names its input and output files and calls one function of the package."""
