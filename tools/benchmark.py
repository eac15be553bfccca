"""`python tools/benchmark.py ...` is `sc3d benchmark ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["benchmark", *sys.argv[1:]])
