"""stad_lab: a car learns a model of its world, drives with it, and dreams in it.

An independent, teachable replication of STAD (Kotyan, Vargas, Venkanna 2019): World Models on
CarRacing, with difference images in the autoencoder. Begin with the notebooks; the command line is
`python -m stad_lab --help`. Importing the package registers two environments with Gymnasium. The
first needs neither PyTorch nor anything else of the extra `train`:

    gymnasium.make("stad_lab:StadLab/CarRacing-v3")
    gymnasium.make("stad_lab:StadLab/Dream-v0", agent="frame", temperature=1.0)
"""

import importlib

from stad_lab.registration import register_when_used

HOMES = {
    "Agent": "agent",
    "Config": "config",
    "load_agent": "agent",
    "make_env": "envs.car_racing",
}
__all__ = ["Agent", "Config", "load_agent", "make_env"]


def __getattr__(name: str):
    """Import a public name when it is first used: `make_env` runs without PyTorch."""
    if name not in HOMES:
        raise AttributeError(f"module 'stad_lab' has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f"stad_lab.{HOMES[name]}"), name)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("stad_lab"):
            raise
        remedy = "pip install 'stad_lab[train]'"
        raise ModuleNotFoundError(f"{error}: {remedy}", name=error.name) from error


def __dir__() -> list[str]:
    """The public names."""
    return __all__


register_when_used()
