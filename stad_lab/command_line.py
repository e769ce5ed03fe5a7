"""What the command lines of the packages share: parsing, errors in one line, and where to write."""

import contextlib
import functools
import io
import re
import sys
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import tyro

# Packages that a few commands need, and the extras that bring them.
EXTRAS = {"matplotlib": "lab", "PIL": "lab", "distributed": "cluster", "envpool": "benchmark"}


@dataclass(frozen=True)
class Program:
    """Commands under one name: each a function, whose arguments are the options."""

    name: str  # as it is called, such as "python -m stad_lab"
    description: str
    commands: dict[str, Callable]
    continues: tuple[str, ...]  # commands that go on after an interrupt


def run(
    program: Program, arguments: list[str] | None = None, choose: Callable | None = None
) -> int:
    """Run one command; returns the exit status. A user's error ends in one line.

    Args:
        arguments: those of this process, if not given.
        choose: changes commands and arguments before they are parsed: (commands, arguments) of
            the arguments.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if hasattr(sys.stdout, "reconfigure"):  # the console may lack letters of a folder's name
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        return parse(program, arguments, choose)() or 0
    except KeyboardInterrupt:
        continues = arguments and arguments[0] in program.continues
        again = "; the same command continues from there" if continues else ""
        print(f"\nstopped{again}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        return 141
    except Exception as error:
        if (message := explain(error)) is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        return 2


def parse(
    program: Program, arguments: list[str], choose: Callable | None = None
) -> Callable[[], int | None]:
    """The command that the arguments ask for, ready to be called.

    tyro calls a command as soon as it has parsed it; this defers it, so that only what the parser
    writes is caught. Wrong usage raises ValueError with one line.
    """
    command, commands = arguments[0] if arguments else "", program.commands
    if command and not command.startswith("-") and command not in commands:
        raise ValueError(f"unknown command {command!r}: choose one of {', '.join(commands)}")
    if choose:
        commands, arguments = choose(arguments)
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.extras.subcommand_cli_from_dict(
                {name: deferred(command) for name, command in commands.items()},
                prog=program.name,
                description=program.description,
                args=arguments,
                sort_subcommands=False,
            )
    except SystemExit as ended:
        if not ended.code:
            raise
        again = f"{program.name} {command}" if command in commands else program.name
        raise ValueError(f"{one_line(told.getvalue())}; see {again} --help") from None


def deferred(command: Callable) -> Callable:
    """The command with the same options, which returns a call instead of making it."""

    @functools.wraps(command)
    def later(*arguments, **named) -> Callable[[], int | None]:
        return functools.partial(command, *arguments, **named)

    return later


def one_line(message: str) -> str:
    """The parser's message without its frame, and without its advice on --help."""
    lines = [re.sub(r"[─│╭╮╰╯]+|-{9,}", "", line).strip() for line in message.splitlines()]
    kept = [line for line in lines if line and line.lower() != "error"]
    text = re.split("Argument helptext|For full helptext", " ".join(kept))[0]
    titles = "Value error|Parsing error|Unrecognized options|Required options|Invalid choice"
    text = re.sub(f"^({titles}|Missing argument) ", "", text).replace(
        "subcommand Expected", "subcommand: expected"
    )
    return text.strip().rstrip(".")


def explain(error: Exception) -> str | None:
    """One line for an error of the user or of the machine; None for a fault of ours."""
    short = re.search("out of memory|allocate memory|could not create a primitive", str(error))
    torch_is_short = isinstance(error, RuntimeError) and short  # PyTorch has no error of its own
    if isinstance(error, MemoryError | OverflowError) or torch_is_short:
        return f"too large for this machine: {error or type(error).__name__}"
    if isinstance(error, ModuleNotFoundError) and "pip install" not in str(error):
        return f"{error}: pip install 'stad_lab[{EXTRAS.get(error.name or '', 'train')}]'"
    known = ValueError, OSError, FloatingPointError, ImportError
    if isinstance(error, known) or type(error).__name__ == "TaskError":
        return str(error)
    return None


def cluster_of(scheduler: str | None) -> contextlib.AbstractContextManager[Executor | None]:
    """The executor of a Dask cluster, or None for this machine's own processes."""
    if scheduler is None:
        return contextlib.nullcontext()
    from stad_lab.io.dask_cluster import cluster

    return cluster(scheduler)


def given(path: str, option: str) -> Path:
    """A folder or file that was asked for. ValueError if it is empty: that would be this folder."""
    if not path.strip():
        raise ValueError(f"{option} is empty: give the name of a folder or file")
    return Path(path)


def output(path: str) -> Path:
    """A folder or file to write to. ValueError if it is empty."""
    return given(path, "--out")
