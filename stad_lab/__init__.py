"""stad_lab: how a car teaches itself to drive inside its own model of the world.

An independent, teachable replication of STAD (Kotyan, Vargas, Venkanna, 2019): World Models on CarRacing, with
difference images in the auto encoder. Start with the notebooks; `python -m stad_lab --help` is the command line.
"""

from stad_lab.agent import Agent, load_agent
from stad_lab.car_racing import make_env
from stad_lab.settings import Settings

__all__ = ["Agent", "Settings", "load_agent", "make_env"]
