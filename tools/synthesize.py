"""`python tools/synthesize.py ...` is `sc3d synthesize ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["synthesize", *sys.argv[1:]])
