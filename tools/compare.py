"""`python tools/compare.py ...` is `sc3d compare ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["compare", *sys.argv[1:]])
