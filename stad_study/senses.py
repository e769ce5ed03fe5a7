"""What C sees in studies 2 and 5: z of a kept V, alone, with h, or with motion added or erased.

The motion is three numbers that the simulator knows: slip speed, yaw rate and wheel angle. They are
added to z after division by their standard deviation in the seed's dataset, or erased from z by the
least change after which no linear model can read them (LEACE: Belrose et al. 2023).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from stad_lab.agent import Agent, Episodes, rollout
from stad_lab.envs.cars import Cars
from stad_lab.evaluation.trajectories import MOTION
from stad_lab.io.weights import WorldModel
from stad_lab.models.controller import check_parameters, parameter_count

ERASED = ("slip speed", "yaw rate", "wheel angle")  # the motion; columns of MOTION
COLUMNS = [list(MOTION).index(name) for name in ERASED]
SEES = ("z", "z, h", "z + motion", "z + placebo", "z + action", "z - motion", "z - placebo")
DRAWS = 10_000  # triples of random directions, of which the nearest in variance is taken


class Eraser(NamedTuple):
    """Replaces z by keep z + shift, float64 (latent_size, latent_size) and (latent_size,)."""

    keep: np.ndarray
    shift: np.ndarray

    def __call__(self, latents: np.ndarray) -> np.ndarray:
        """z without the erased directions: float32 (n, latent_size)."""
        return (latents @ self.keep.T + self.shift).astype(np.float32)


class Whitening(NamedTuple):
    """Statistics of z that an eraser is made from."""

    mean: np.ndarray  # (latent_size,)
    root: np.ndarray  # of the covariance, symmetric
    inverse: np.ndarray  # of the root; zero along directions without variance


def whiten(latents: np.ndarray) -> Whitening:
    """The mean of z, (n, latent_size), and the roots of its covariance."""
    values, vectors = np.linalg.eigh(np.cov(latents.astype(np.float64), rowvar=False))
    varies = values > values.max() * 1e-9
    scale = np.sqrt(np.where(varies, values, 0))
    inverse = np.where(varies, 1 / np.where(varies, scale, 1), 0)
    mean = latents.mean(axis=0, dtype=np.float64)
    return Whitening(mean, (vectors * scale) @ vectors.T, (vectors * inverse) @ vectors.T)


def erase(white: Whitening, directions: np.ndarray) -> Eraser:
    """Erase directions of the whitened z, (latent_size, count), by the least change of z."""
    basis, _ = np.linalg.qr(directions)
    removed = white.root @ basis @ basis.T @ white.inverse
    return Eraser(np.eye(len(removed)) - removed, removed @ white.mean)


def motion_directions(white: Whitening, latents: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """The directions of the whitened z, (latent_size, 3), that covary with the motion (n, 3)."""
    centred = motion.astype(np.float64) - motion.mean(axis=0, dtype=np.float64)
    covariance = (latents - white.mean).T @ (centred / centred.std(axis=0)) / len(latents)
    return white.inverse @ covariance


def removed_variance(white: Whitening, directions: np.ndarray) -> float:
    """The variance of z that `erase` takes away with these directions."""
    basis, _ = np.linalg.qr(directions)
    return float(np.sum((white.root @ basis) ** 2))


def random_directions(white: Whitening, variance: float, rng: np.random.Generator) -> np.ndarray:
    """Three random directions of the whitened z that take away nearly this variance.

    They are drawn from a normal distribution whose covariance is a power of that of z: with power 0
    all directions are alike, with a larger one those of much variance are likelier. The power is
    the least of 0, 1, 2 ... 8 whose draws exceed the variance more than once in ten; then the draw
    nearest to the variance is taken.
    """
    size = len(white.mean)
    for power in range(9):
        shape = np.linalg.matrix_power(white.root, power)
        draws = shape @ rng.standard_normal((DRAWS, size, 3))
        found = np.array([removed_variance(white, one) for one in draws])
        if np.mean(found > variance) > 0.1:
            break
    return draws[np.abs(found - variance).argmin()]


@dataclass(frozen=True)
class Sense:
    """A world model, and what C sees of it: `evolve` drives with it as with a world model."""

    world_model: WorldModel
    sees: str  # one of SEES
    eraser: Eraser | None = None
    scale: np.ndarray | None = None  # standard deviations of the three numbers beside z
    others: Sequence[np.ndarray] = ()  # motion (T, 3) of the episodes that the placebo shows

    @property
    def sizes(self) -> tuple[int, int]:
        """How many numbers z has, and how many C sees beside it."""
        latent_size, hidden_size = self.world_model.sizes
        return latent_size, 3 if "+" in self.sees else hidden_size

    @property
    def checksums(self) -> dict[str, str]:
        """Of V and M, and what C sees: what a controller or a log must belong to."""
        return {**self.world_model.checksums, "sees": self.sees}

    def features(self, latents: np.ndarray, beside: np.ndarray) -> np.ndarray:
        """What C sees: float32 (n, latent_size + numbers beside z).

        Args:
            latents: z, (n, latent_size).
            beside: h (n, hidden_size), or the three numbers in their own units (n, 3).
        """
        if self.eraser:
            latents = self.eraser(latents)
        if self.scale is not None:
            beside = beside / self.scale
        return np.concatenate([latents, beside], axis=1).astype(np.float32)

    def other_motion(self, episode: int, frames: int | np.ndarray) -> np.ndarray:
        """The placebo's motion in some frames of an episode; it begins again at its end."""
        other = self.others[episode % len(self.others)]
        return other[frames % len(other)]

    def drive(self, parameters: np.ndarray, tracks: Sequence[int], **limits) -> Episodes:
        """Drive one episode on each track, as `stad_lab.agent.drive`."""
        cars = Cars(len(tracks), "frame", bar=not self.world_model.crop_bar)
        cars.reset(tracks)
        return rollout(SensingAgent(self, parameters, cars, tracks), cars, **limits)


class SensingAgent(Agent):
    """V + M + C for a batch of cars, of which C sees what a Sense says."""

    def __init__(self, sense: Sense, parameters: np.ndarray, cars: Cars, tracks: Sequence[int]):
        self.sense, self.batch, self.tracks = sense, cars, tracks
        check_parameters(parameters, parameter_count(*sense.sizes))
        unused = np.zeros(parameter_count(*sense.world_model.sizes))
        super().__init__(sense.world_model, unused, remembers=sense.sees == "z, h")
        self.parameters = parameters

    def reset(self) -> None:
        """Forget the past."""
        super().reset()
        self.frame = 0
        self.actions: Any = None  # an array from the first step on

    def act_batch(self, seen: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """The actions of the present cars, float32 (cars, 3)."""
        if self.actions is None:
            self.actions = np.zeros((len(seen), 3), np.float32)
        self.actions = super().act_batch(seen)
        self.frame += 1
        return self.actions

    def keep(self, cars: np.ndarray) -> None:
        """Continue with some of the present cars."""
        super().keep(cars)
        self.actions = self.actions[cars]

    def features(self) -> np.ndarray:
        """What C sees, float32 (cars, latent_size + numbers beside z)."""
        return self.sense.features(self.latents, self.beside())

    def beside(self) -> np.ndarray:
        """What C sees beside z: h, or three numbers in their own units."""
        sees = self.sense.sees
        if sees == "z + motion":
            return turning(self.batch, self.cars)
        if sees == "z + placebo":
            others = [self.sense.other_motion(self.tracks[car], self.frame) for car in self.cars]
            return np.array(others)
        return self.actions if sees == "z + action" else self.hidden


def turning(cars: Cars, which: np.ndarray) -> np.ndarray:
    """Slip speed, yaw rate and wheel angle of some cars: float64 (n, 3), units as in MOTION."""
    velocity, angles = cars.cars["velocity"][which, 0], cars.cars["angle"][which]
    hull = angles[:, 0].astype(np.float64)
    slip = np.cos(hull) * velocity[:, 0] + np.sin(hull) * velocity[:, 1]
    return np.stack([slip, velocity[:, 2], angles[:, 1] - angles[:, 0]], axis=1)
