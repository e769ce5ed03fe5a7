"""stad_lab: a car learns a model of its world, drives with it, and dreams in it.

An independent, teachable replication of STAD (Kotyan, Vargas, Venkanna 2019): World Models on
CarRacing, with difference images in the autoencoder. Begin with the notebooks; the command line is
`python -m stad_lab --help`. Importing the package registers two environments with Gymnasium:

    gymnasium.make("stad_lab:StadLab/CarRacing-v3")
    gymnasium.make("stad_lab:StadLab/Dream-v0", source="frame")
"""

import contextlib
import importlib

HOMES = {
    "Agent": "agent",
    "Config": "config",
    "check_environment": "doctor",
    "load_agent": "agent",
    "make_env": "envs.car_racing",
}
__all__ = ["Agent", "Config", "check_environment", "load_agent", "make_env"]


def __getattr__(name: str):
    """Import a public name when it is first used: `check_environment` runs without PyTorch."""
    if name not in HOMES:
        raise AttributeError(f"module 'stad_lab' has no attribute {name!r}")
    return getattr(importlib.import_module(f"stad_lab.{HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names."""
    return __all__


# By the names of their modules, which Gymnasium imports when an environment is made. Without a
# working Gymnasium the doctor must still run: it reports what is wrong.
with contextlib.suppress(Exception):
    from gymnasium import register

    car_racing = "stad_lab.envs.car_racing:FastCarRacing"
    register("StadLab/CarRacing-v3", car_racing, reward_threshold=900, max_episode_steps=1000)
    register("StadLab/Dream-v0", "stad_lab.dreaming:make_dream")
