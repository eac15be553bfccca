"""`python tools/check.py ...` is `sc3d check ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["check", *sys.argv[1:]])
