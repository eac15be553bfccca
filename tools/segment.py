"""`python tools/segment.py ...` is `sc3d segment ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["segment", *sys.argv[1:]])
