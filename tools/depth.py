"""`python tools/depth.py ...` is `sc3d depth ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["depth", *sys.argv[1:]])
