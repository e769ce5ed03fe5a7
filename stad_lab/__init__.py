"""stad_lab: how a car learns a model of its world, drives with it, and dreams in it.

An independent, teachable replication of STAD (Kotyan, Vargas, Venkanna, 2019): World Models on CarRacing, with
difference images in the autoencoder. Start with the notebooks; `python -m stad_lab --help` is the command line.
"""

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
    """Import a public name when it is first asked for, so that `check_environment` runs where PyTorch does not."""
    if name not in HOMES:
        raise AttributeError(f"module 'stad_lab' has no attribute {name!r}")
    return getattr(importlib.import_module(f"stad_lab.{HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names."""
    return __all__
