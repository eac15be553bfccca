"""`python tools/label.py ...` is `sc3d label ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["label", *sys.argv[1:]])
