"""`python -m stad_study`: the command line of `stad_study.cli`."""

import sys

from stad_lab.streams import open_program

if __name__ == "__main__":
    open_program(progress=("replicate", "latents", "probe"))
    from stad_study.cli import main

    sys.exit(main())
