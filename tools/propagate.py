"""`python tools/propagate.py ...` is `sc3d propagate ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["propagate", *sys.argv[1:]])
