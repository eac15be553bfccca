"""`python tools/doctor.py ...` is `sc3d doctor ...`; see --help."""

import sys

from sc3d.cli import main

if __name__ == "__main__":
    main(["doctor", *sys.argv[1:]])
