"""`python tools/annotate.py ...` is `sc3d annotate ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["annotate", *sys.argv[1:]])
