"""`python tools/georeference.py ...` is `sc3d georeference ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["georeference", *sys.argv[1:]])
