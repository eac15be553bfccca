"""`python tools/evaluate.py ...` is `sc3d evaluate ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
