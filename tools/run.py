"""`python tools/run.py ...` is `sc3d run ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["run", *sys.argv[1:]])
