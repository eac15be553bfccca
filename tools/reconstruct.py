"""`python tools/reconstruct.py ...` is `sc3d reconstruct ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["reconstruct", *sys.argv[1:]])
