"""Output that may be gone: a training does not end because nobody reads what it prints."""

import importlib
import os
import sys
from typing import NoReturn, TextIO


def open_missing_streams() -> None:
    """Give a process the standard streams that it was started without, as with `2>&-`.

    They lead nowhere. Otherwise the next file that is opened would take the place of one, and get
    what a library prints.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115


class Lasting:
    """A text stream that discards everything after a write has failed.

    The terminal was closed, or the reader of a pipe has ended, as `| head -1` does.
    """

    def __init__(self, stream: TextIO):
        self.stream = stream

    def write(self, text: str) -> int:
        """As for every stream; what was not printed yet is lost."""
        try:
            return self.stream.write(text)
        except OSError:
            self.lead_nowhere()
            return len(text)

    def flush(self) -> None:
        """As for every stream."""
        try:
            self.stream.flush()
        except OSError:
            self.lead_nowhere()

    def lead_nowhere(self) -> None:
        """Replace the file below the stream, so that the last flush succeeds, too."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.stream.fileno())
        os.close(nowhere)

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)


def make_streams_last() -> None:
    """Let this process outlive the readers of its output."""
    sys.stdout, sys.stderr = Lasting(sys.stdout), Lasting(sys.stderr)


def run_program(package: str, progress: tuple[str, ...]) -> NoReturn:
    """Run a package's command line, `main` of its module `cli`, and end with its status.

    Commands in `progress` outlive the readers of their output.
    """
    open_missing_streams()
    if sys.argv[1:2] and sys.argv[1] in progress:
        make_streams_last()
    try:
        main = importlib.import_module(f"{package}.cli").main
    except KeyboardInterrupt:  # which `main` itself handles
        print("\nstopped", file=sys.stderr)
        sys.exit(130)
    except ModuleNotFoundError as error:
        print(f"error: {error}: pip install 'stad_lab[train]'", file=sys.stderr)
        sys.exit(2)
    sys.exit(main())
