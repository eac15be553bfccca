"""`python tools/export.py ...` is `sc3d export ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["export", *sys.argv[1:]])
