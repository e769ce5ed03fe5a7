"""`python -m stad_course`: the command line of `stad_course.cli`."""

import sys

from stad_lab.streams import open_program

if __name__ == "__main__":
    open_program(progress=())
    from stad_course.cli import main

    sys.exit(main())
