"""The command line of a course, `python -m stad_course COMMAND`."""

from collections.abc import Callable
from pathlib import Path

import tyro

from stad_course.compete.limits import Limits
from stad_lab import command_line
from stad_lab.command_line import given, output


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status. A user's error ends in one line."""
    return command_line.run(PROGRAM, arguments)


def doctor() -> int:
    """Say whether everything is installed, and what to do about what is not."""
    from stad_course.doctor import tell_environment

    return tell_environment()


def kit(file: tyro.conf.Positional[str]) -> None:
    """Write a first agent to a file, to begin from.

    Args:
        file: The .py to write.
    """
    from stad_course.compete import run

    print(run.write_kit(given(file, "the name of the file")))


def check(submission: tyro.conf.Positional[str], limits: Limits = Limits()) -> int:  # noqa: B008
    """Try one submission on three public tracks, as its author would.

    Args:
        submission: A Python file with make_agent(), a folder with such an agent.py, or a run.
        limits: What a submission may use.
    """
    from stad_course.compete.drive import check_submission

    said = check_submission(given(submission, "the submission"), limits)
    print(said)
    return int(said.startswith("FAILED"))


def commit(secret: tyro.conf.Positional[str], tracks: int | None = None) -> None:
    """Draw hidden tracks, keep them in a file, and print the hash to publish.

    Of a file that exists only the hash is printed.

    Args:
        secret: The file of hidden tracks, ending in .json.
        tracks: How many to draw; 50 if not given.
    """
    from stad_course.compete.tracks import hide_tracks

    print(hide_tracks(given(secret, "the file of hidden tracks"), tracks))


def compete(
    submissions: tyro.conf.Positional[str],
    secret: Path,
    out: str = "competition",
    reveal: bool = False,
    baselines: bool = True,
    processes: int = 2,
    limits: Limits = Limits(),  # noqa: B008
) -> None:
    """Rank the agents of a class on hidden tracks, each in a process of its own.

    Stop it when you like; the same command continues.

    Args:
        submissions: Folder with one Python file with make_agent(), or one folder, for each agent.
        secret: The file of hidden tracks, made by `commit`.
        out: Folder of the results and of leaderboard.html.
        reveal: Print seeds and salt on the leaderboard.
        baselines: Rank random actions, constant ones and four shipped agents, too.
        processes: Submissions that drive at once.
        limits: What a submission may use.
    """
    from stad_course.compete import run

    folder = given(submissions, "the folder of submissions")
    page = run.run(folder, secret, output(out), limits, processes, reveal, baselines)
    print(f"written to {page}")


COMMANDS: dict[str, Callable] = {
    "doctor": doctor,
    "kit": kit,
    "check": check,
    "commit": commit,
    "compete": compete,
}
PROGRAM = command_line.Program(
    "python -m stad_course", "What a class needs.", COMMANDS, continues=("compete",)
)
