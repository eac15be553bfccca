"""`python tools/extract.py ...` is `sc3d extract ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["extract", *sys.argv[1:]])
