"""`python tools/report.py ...` is `sc3d report ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["report", *sys.argv[1:]])
