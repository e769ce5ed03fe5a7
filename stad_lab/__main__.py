"""`python -m stad_lab`: the command line of `stad_lab.cli`."""

import sys

from stad_lab.cli import main

if __name__ == "__main__":
    sys.exit(main())
