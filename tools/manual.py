"""`python tools/manual.py ...` is `sc3d manual ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["manual", *sys.argv[1:]])
