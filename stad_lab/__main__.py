"""`python -m stad_lab`: the command line of `stad_lab.cli`."""

import io
import sys

from stad_lab.streams import open_missing_streams, run_program

if __name__ == "__main__":
    if sys.argv[1:] == ["check"]:  # it must run where the command line's own packages are missing
        open_missing_streams()
        from stad_lab.doctor import tell_environment

        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # for letters that a console lacks
        sys.exit(tell_environment())
    run_program("stad_lab", progress=("train", "fine-tune", "probe"))
