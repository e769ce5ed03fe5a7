"""`python -m stad_lab`: the command line of `stad_lab.cli`."""

import sys

if __name__ == "__main__":
    if sys.argv[1:] == ["check"]:  # it must run where the command line's own packages are missing
        from stad_lab.doctor import tell_environment

        sys.stdout.reconfigure(errors="backslashreplace")  # for letters that a console lacks
        sys.exit(tell_environment())
    from stad_lab.cli import main

    sys.exit(main())
