"""`python -m stad_lab`: the command line of `stad_lab.cli`."""

import io
import sys

from stad_lab.streams import open_program

if __name__ == "__main__":
    open_program(progress=("train", "fine-tune", "probe"))
    if sys.argv[1:] == ["check"]:  # it must run where the command line's own packages are missing
        from stad_lab.doctor import tell_environment

        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # for letters that a console lacks
        sys.exit(tell_environment())
    try:
        from stad_lab.cli import main
    except KeyboardInterrupt:  # which `main` itself handles
        print("\nstopped", file=sys.stderr)
        sys.exit(130)
    except ModuleNotFoundError as error:
        print(f"error: {error}: pip install 'stad_lab[train]'", file=sys.stderr)
        sys.exit(2)
    sys.exit(main())
