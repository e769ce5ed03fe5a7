"""The process that runs a submission: it is shown pictures and answers with actions, no more.

The parent starts it with the submission's path and the limit of memory in bytes. It never learns a
track's seed, and what it says of rewards is not asked.
"""

import contextlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stad_course.compete.protocol import receive, send

AGENT_FILE = "agent.py"  # of a submission that is a folder
LONGEST_ERROR = 300  # characters
PROCESSES, FILE_SIZE = 64, 100_000_000  # of a submission; bytes


class Separate:
    """A batch of agents that act for one car each, as `make_agent` gives them."""

    def __init__(self, make: Callable[[], Any], first: Any):
        self.make, self.agents, self.cars = make, [first], [0]

    def reset(self, count: int) -> None:
        """Begin an episode with each of `count` cars."""
        self.agents += [self.make() for _ in range(count - len(self.agents))]
        self.cars = list(range(count))
        for agent in self.agents[:count]:
            if hasattr(agent, "reset"):
                agent.reset()

    def act(self, pictures: np.ndarray) -> np.ndarray:
        """Actions float64 (cars, 3) for observations uint8 (cars, 96, 96, 3)."""
        pairs = zip(self.cars, pictures, strict=True)
        return np.array([action_of(self.agents[car].act(one), (3,)) for car, one in pairs])

    def keep(self, cars: list[int]) -> None:
        """Continue with some of the present cars."""
        self.cars = [self.cars[car] for car in cars]


class Together:
    """One agent that acts for many cars at once, by `act_batch` and `keep`."""

    def __init__(self, agent: Any):
        self.agent = agent

    def reset(self, count: int) -> None:
        """Begin an episode with each of `count` cars."""
        self.agent.reset()

    def act(self, pictures: np.ndarray) -> np.ndarray:
        """Actions float64 (cars, 3) for observations uint8 (cars, 96, 96, 3)."""
        return action_of(self.agent.act_batch(pictures), (len(pictures), 3))

    def keep(self, cars: list[int]) -> None:
        """Continue with some of the present cars."""
        self.agent.keep(np.array(cars))


def action_of(answer: object, shape: tuple[int, ...]) -> np.ndarray:
    """An answer as float64. ValueError for another shape, or numbers that are not finite."""
    action = np.asarray(answer, np.float64)
    if action.shape != shape:
        raise ValueError(f"an action of shape {action.shape}, expected {shape}")
    if not np.isfinite(action).all():
        raise ValueError(f"the action {action.tolist()} is not finite"[:LONGEST_ERROR])
    return action


def load_submission(path: Path) -> Separate | Together:
    """The agent of a file with `make_agent()`, a folder with agent.py, or a run's folder."""
    file = path / AGENT_FILE if path.is_dir() else path
    if not file.exists():
        from stad_lab.agent import load_agent
        from stad_lab.io.weights import VAE_FILE

        if not (path / VAE_FILE).exists():
            raise ValueError("the folder holds neither agent.py with make_agent(), nor a run")

        return Together(load_agent(path))
    sys.path.append(str(file.parent))
    spec = importlib.util.spec_from_file_location("submission", file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file.name} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules["submission"] = module
    spec.loader.exec_module(module)
    if not callable(getattr(module, "make_agent", None)):
        raise ValueError("the file has no function make_agent()")
    agent = module.make_agent()
    if type(agent).__module__ == "stad_lab.agent":  # a subclass may have an `act` of its own
        return Together(agent)
    if not callable(getattr(agent, "act", None)):
        raise ValueError("make_agent() must return an object with a method act(observation)")
    return Separate(module.make_agent, agent)


def limit_resources(memory: int) -> None:
    """Let the system refuse memory, processes and files beyond the limits, where it can."""
    with contextlib.suppress(ImportError):  # not on Windows
        import resource

        limits = {"RLIMIT_DATA": memory, "RLIMIT_CORE": 0, "RLIMIT_FSIZE": FILE_SIZE}
        if os.environ.get("STAD_LAB_ISOLATED"):  # or all processes of the user would count
            limits["RLIMIT_NPROC"] = PROCESSES
        for name, most in limits.items():
            with contextlib.suppress(AttributeError, ValueError, OSError):
                resource.setrlimit(getattr(resource, name), (most, most))


def explain(error: BaseException, path: Path) -> str:
    """One line on an error, with the last line of the submission that it came from."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if within(frame, path)]
    where = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    if isinstance(error, SystemExit):
        return f"it called sys.exit{where}"
    if isinstance(error, MemoryError):
        return f"it needs more memory than the limit{where}"
    text = " ".join(str(error).split())[:LONGEST_ERROR]
    return f"{type(error).__name__}: {text}{where}"


def within(frame: traceback.FrameSummary, path: Path) -> bool:
    """Whether a frame of a traceback lies in the submission."""
    return Path(frame.filename).is_relative_to(path)


def answer(agent: Separate | Together, fields: dict, pictures: np.ndarray) -> np.ndarray | None:
    """Do what the parent asks; the actions if it asked for some."""
    if fields["kind"] == "reset":
        return agent.reset(fields["cars"])
    if fields["kind"] == "keep":
        return agent.keep(fields["cars"])
    return agent.act(pictures)


def main() -> None:
    """Load a submission, then answer until the parent closes the pipe."""
    path, memory = Path(sys.argv[1]), int(sys.argv[2])
    asked, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # what a submission prints must not mix with the answers
        os.dup2(nothing, stream)
    limit_resources(memory)
    try:
        agent = load_submission(path)
        send(answers, "ready")
        while True:
            fields, pictures = receive(asked, np.uint8)
            actions = answer(agent, fields, pictures.copy())  # writable, as Gymnasium's
            send(answers, "ready" if actions is None else "actions", actions)
    except EOFError:
        pass
    except BaseException as error:
        with contextlib.suppress(OSError):
            send(answers, "error", text=explain(error, path))
    os._exit(0)  # threads of the submission may go on


if __name__ == "__main__":
    main()
