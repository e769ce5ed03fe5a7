"""C, the controller: one linear layer from z and h to the action.

It is so small that an evolution strategy can train it from returns alone: z (32 numbers) and h
(256) to three outputs make 3 x 288 weights + 3 biases = 867 parameters. They are kept as one flat
vector, weights first, as CMA-ES wants them. (World Models, Ha and Schmidhuber 2018, section 2.3.)
"""

import numpy as np

ACTION_SIZE = 3  # steering, gas, brake


def parameter_count(latent_size: int, hidden_size: int) -> int:
    """Number of parameters of C: 867 for z of 32 and h of 256."""
    return ACTION_SIZE * (latent_size + hidden_size) + ACTION_SIZE


def initial_parameters(latent_size: int, hidden_size: int, gas: float = 0.0) -> np.ndarray:
    """The first C of an evolution: weights 0, bias of the gas at `gas`; float64 (parameters,)."""
    parameters = np.zeros(parameter_count(latent_size, hidden_size))
    parameters[-ACTION_SIZE + 1] = gas
    return parameters


def seen_columns(features: str, latent_size: int, hidden_size: int) -> np.ndarray:
    """Which of z and h C sees, "z, h", "z" or "h": bool (latent_size + hidden_size,)."""
    return np.repeat(["z" in features, "h" in features], [latent_size, hidden_size])


def unpack(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (..., 3, features) and biases (..., 3) of C's parameters (..., parameters)."""
    weights, bias = parameters[..., :-ACTION_SIZE], parameters[..., -ACTION_SIZE:]
    return weights.reshape(*bias.shape, -1), bias


def control(parameters: np.ndarray, features: np.ndarray) -> np.ndarray:
    """The action of each car.

    Args:
        parameters: (parameters,) for the same C in all cars, or (cars, parameters).
        features: z and h side by side, (cars, latent_size + hidden_size).

    Returns:
        Steering in [-1, 1], gas and brake in [0, 1], float32 (cars, 3).

    Raises:
        ValueError: an action that is not finite; CarRacing itself would not refuse it.
    """
    weights, bias = unpack(np.atleast_2d(parameters))
    with np.errstate(invalid="ignore"):  # 0 x infinity is reported below
        raw = np.einsum("...ij,...j->...i", weights, features.astype(weights.dtype)) + bias
    if not np.isfinite(raw).all():
        bad = raw[~np.isfinite(raw).all(axis=1)][0]
        raise ValueError(f"action {bad}: expected finite numbers; check z, h and C for NaN")
    return squash(raw).astype(np.float32)


def squash(raw: np.ndarray) -> np.ndarray:
    """Bound outputs (..., 3) as World Models does: tanh, (tanh + 1) / 2 and max(tanh, 0)."""
    steering, gas, brake = np.moveaxis(np.tanh(raw), -1, 0)
    return np.stack([steering, (gas + 1) / 2, np.clip(brake, 0, 1)], axis=-1)


def check_parameters(parameters: np.ndarray, count: int, source: object = "controller") -> None:
    """Raise ValueError unless the parameters are finite, (count,) or (cars, count)."""
    if not isinstance(parameters, np.ndarray) or parameters.dtype.kind != "f":
        raise ValueError(f"{source}: expected parameters as an array of floats")
    if parameters.ndim not in (1, 2) or parameters.shape[-1] != count:
        raise ValueError(
            f"{source}: parameters of shape {parameters.shape}, expected ({count},) or"
            f" (cars, {count}): the controller belongs to a V or M of another size"
        )
    if not np.isfinite(parameters).all():
        raise ValueError(f"{source}: parameters that are not finite: evolve the controller again")
