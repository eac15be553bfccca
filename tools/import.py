"""`python tools/import.py ...` is `sc3d import ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["import", *sys.argv[1:]])
