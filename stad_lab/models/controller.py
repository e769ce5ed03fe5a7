"""C, the controller: one linear layer from what V and M know to the action, and nothing else.

It is kept so small that an evolution strategy can train it from returns alone: z (32) and h (256) to three outputs make
3 x 288 weights + 3 biases = 867 parameters. Its parameters are one flat vector, weights first, as CMA-ES wants them.
"""

from pathlib import Path

import numpy as np

from stad_lab.models.mdn_rnn import ACTION_SIZE


def parameter_count(latent_size: int, hidden_size: int) -> int:
    """Number of parameters of C: 867 for z of 32 and h of 256."""
    return ACTION_SIZE * (latent_size + hidden_size) + ACTION_SIZE


def initial_parameters(latent_size: int, hidden_size: int, gas: float = 0.0) -> np.ndarray:
    """Where evolution starts: all weights zero and the gas output's bias at `gas`; float64 (parameters,)."""
    parameters = np.zeros(parameter_count(latent_size, hidden_size))
    parameters[-ACTION_SIZE + 1] = gas
    return parameters


def seen_columns(features: str, latent_size: int, hidden_size: int) -> np.ndarray:
    """Which of z and h C sees, for `Settings.features`: bool (latent_size + hidden_size,). Other weights are 0."""
    return np.repeat(["z" in features, "h" in features], [latent_size, hidden_size])


def check_parameters(parameters: np.ndarray, count: int, source: str | Path = "controller") -> None:
    """Raise ValueError unless `parameters` is one finite vector of `count`, or a stack of them (cars, count)."""
    if parameters.ndim not in (1, 2) or parameters.shape[-1] != count:
        raise ValueError(
            f"{source}: parameters of shape {parameters.shape}, expected ({count},) or (cars, {count}): the controller"
            " belongs to a V or M of another size"
        )
    if not np.isfinite(parameters).all():
        raise ValueError(
            f"{source}: parameters that are not finite (NaN or infinite): evolve the controller again"
        )


def unpack(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (..., 3, features) and biases (..., 3) of C's parameters (..., parameters)."""
    weights, bias = parameters[..., :-ACTION_SIZE], parameters[..., -ACTION_SIZE:]
    return weights.reshape(*bias.shape, -1), bias


def control(parameters: np.ndarray, features: np.ndarray) -> np.ndarray:
    """The action of each car.

    Args:
        parameters: (parameters,) for one controller in all cars, or (cars, parameters) for one controller each.
        features: z and h side by side, (cars, latent_size + hidden_size).

    Returns:
        float32 (cars, 3): steering in [-1, 1], gas and brake in [0, 1].

    Raises:
        ValueError: an action that is not finite. CarRacing would not refuse it: a NaN once earned an instant 999 there.
    """
    weights, bias = unpack(np.atleast_2d(parameters))
    with np.errstate(invalid="ignore"):  # 0 x infinity is reported below
        raw = (weights * features[:, None]).sum(-1) + bias
    if not np.isfinite(raw).all():
        bad = raw[~np.isfinite(raw).all(axis=1)][0]
        raise ValueError(
            f"action {bad} before squashing, expected finite numbers: check z, h and C for NaN"
        )
    return squash(raw).astype(np.float32)


def squash(raw: np.ndarray) -> np.ndarray:
    """Bound the three outputs as World Models does: steering tanh, gas (tanh + 1) / 2, brake tanh cut off below 0."""
    steering, gas, brake = np.moveaxis(np.tanh(raw), -1, 0)
    return np.stack([steering, (gas + 1) / 2, np.clip(brake, 0, 1)], axis=-1)
