"""C drives in a dream: from nothing (`make_dream`), or from where an agent is (`dream_on`)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from stad_lab.agent import MAX_FRAMES, Agent, EnvBatch, rollout, run_folder
from stad_lab.envs.arguments import whole_number
from stad_lab.envs.dream import DreamEnv
from stad_lab.envs.dreams import DreamVector
from stad_lab.io.weights import load_world_model
from stad_lab.models.controller import control
from stad_lab.models.mdn_rnn import to_state


def make_dream(agent: str | Path = "frame", temperature: float = 1.0, **options) -> DreamEnv:
    """The dream of an agent; `gymnasium.make("stad_lab:StadLab/Dream-v0")` calls this.

    `agent` is a shipped agent, or the folder of a run with V and M; the options are `DreamEnv`'s.
    """
    world_model = load_world_model(run_folder(agent))
    return DreamEnv(world_model.vae, world_model.mdn_rnn, temperature, **options)


def make_dreams(agent: str | Path = "frame", **options) -> DreamVector:
    """Many dreams of an agent, as `make_dream`; the options are `DreamVector`'s."""
    world_model = load_world_model(run_folder(agent))
    return DreamVector(world_model.vae, world_model.mdn_rnn, **options)


class Dreamer:
    """C at the wheel of one dream: a driver for `agent.rollout`."""

    def __init__(self, env: DreamEnv, parameters: np.ndarray):
        self.env, self.parameters = env, parameters

    def reset(self) -> None:
        """Nothing: the memory is the dream's."""

    def act_batch(self, seen: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """C's action for z and the dream's h: float32 (1, 3)."""
        return control(self.parameters, np.concatenate([seen[0], self.env.hidden])[None])

    def keep(self, cars: np.ndarray) -> None:
        """Nothing: there is one car."""


def dream_on(
    agent: Agent, frames: int, temperature: float = 1.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Continue an agent's episode in the dream: from here on C sees what M predicts.

    The first z is sampled from M's prediction after the agent's last action. The agent drives one
    car, has acted since its last reset, and is not changed.

    Returns:
        The dreamed frames, uint8 (frames, 64, 64, 3), and the actions, float32 (frames, 3).
    """
    frames = whole_number("frames", frames, 1, MAX_FRAMES)
    seed = whole_number("seed", seed, 0, 2**63 - 1)
    state = to_state(agent.state)
    if state is None:
        raise ValueError("the agent has not acted yet: let it drive some real frames first")
    if len(agent.cars) != 1:
        raise ValueError(
            f"the agent drives {len(agent.cars)} cars, expected one: use agent.keep(np.array([0]))"
        )
    with torch.no_grad():
        prediction = agent.mdn_rnn.mixture(state[0])
        latents = prediction.sample(temperature, torch.Generator().manual_seed(seed))[0, 0]
    env = DreamEnv(agent.vae, agent.mdn_rnn, temperature, frames, render_mode="rgb_array")
    first, _ = env.reset(seed=seed, options={"latents": latents.numpy(), "state": state})
    pictures, actions = [], []

    def record(_: np.ndarray, seen: np.ndarray, action: np.ndarray) -> None:
        pictures.append(env.render())
        actions.append(action[0])

    dreamer = Dreamer(env, agent.present_parameters())
    rollout(dreamer, EnvBatch([env], [first]), frames, observe=record)
    return np.array(pictures), np.array(actions)
