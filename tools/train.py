"""`python tools/train.py ...` is `sc3d train ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
