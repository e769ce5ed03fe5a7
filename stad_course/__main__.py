"""`python -m stad_course`: the command line of `stad_course.cli`."""

import io
import sys

from stad_lab.streams import open_missing_streams, run_program

if __name__ == "__main__":
    if sys.argv[1:] == ["doctor"]:  # it must run where the command line's own packages are missing
        open_missing_streams()
        from stad_course.doctor import tell_environment

        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # for letters that a console lacks
        try:
            sys.exit(tell_environment())
        except KeyboardInterrupt:
            print("\nstopped", file=sys.stderr)
            sys.exit(130)
    run_program("stad_course", progress=("compete",))
