"""`python tools/view.py ...` is `sc3d view ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["view", *sys.argv[1:]])
