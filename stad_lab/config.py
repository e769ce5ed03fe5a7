"""The settings: one frozen dataclass with three presets, `quick`, `laptop` and `paper`.

Every number that one may want to change for a run is here, with its unit. A run's settings are written into its folder,
so a result can always be traced back to them.
"""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

ENVIRONMENT_VARIABLE = "STAD_LAB_SETTINGS"


@dataclass(frozen=True)
class Settings:
    """Everything that shapes a run. Defaults are the `laptop` preset.

    Raises:
        ValueError: a value of the wrong type or out of its range, with the name, the value and what was expected.
    """

    name: str = "laptop"
    """Name of the preset these settings began as."""
    seed: int = 0
    """Seed of the whole run: data and weights follow from it, and with `evolution_seed` the search for C."""
    processes: int = 2
    """Worker processes that drive cars; a search can use one for each group of `cars`. The results are the same."""

    # Frames and differences (paper, sections 3.1 and 4)
    crop_bar: bool = True
    """Cut the indicator bar (lowest 12 of 96 rows) off before shrinking, as World Models does."""
    stride: int = 4
    """k of the difference image d_t = x_t - x_(t-k), in frames."""

    # Rollouts of the random driver
    episodes: int = 900
    """Episodes to collect."""
    episode_frames: int = 120
    """Frames of an episode, at most. A random driver is soon off the road: short episodes see more of it."""
    random_starts: float = 0.9
    """Share of the episodes that start moving, on a random tile, instead of at rest on tile 0."""
    agent_episodes: int = 0
    """Episodes that the agent of an earlier run drives for the dataset, in a second round; 0 in a first one."""

    # V, the autoencoder
    latent_size: int = 32
    """Dimensions of z."""
    width: int = 16
    """Channels of V's first convolution; the others follow from it. World Models has 32."""
    kl_weight: float = 0.25
    """Weight of the KL term against the squared errors. World Models has 1."""
    free_bits: float = 0.0
    """A picture's whole KL costs nothing below so many nats times `latent_size`. World Models has 0.5."""
    difference_weight: float = 1.0
    """Weight of the difference image's squared error, in the variants that redraw it."""
    v_steps: int = 5000
    """Training steps of V."""
    v_batch: int = 128
    """Frames in a batch."""
    v_learning_rate: float = 1e-3
    """Adam's rate at the start; it falls to a tenth along a cosine."""

    # M, the MDN-RNN
    hidden_size: int = 256
    """Units of the LSTM."""
    mixtures: int = 5
    """Gaussians in the mixture of each latent dimension."""
    m_steps: int = 1500
    """Training steps of M."""
    m_batch: int = 64
    """Sequences in a batch."""
    m_sequence: int = 100
    """Frames in a sequence."""
    m_learning_rate: float = 2e-3
    """Adam's rate at the start; it falls to a tenth along a cosine."""

    # C, evolved by CMA-ES
    generations: int = 55
    """Generations of CMA-ES."""
    population: int = 64
    """Agents in a generation."""
    tracks: int = 1
    """Tracks that each agent drives in a generation; all agents of a generation drive the same ones."""
    revisited_share: float = 0.0
    """Share of the tracks that are hard ones of before again, instead of new ones."""
    sigma: float = 0.1
    """CMA-ES's first step size."""
    sigma_decay: float = 0.97
    """What the step size is multiplied with in every generation; 0 leaves it to CMA-ES."""
    components: int = 48
    """Search along so many principal components of what C sees; 0 for along every weight of its own."""
    evolution_seed: int = 0
    """Seed of the mutations and of the tracks that are evolved on: several searches may share one V and M."""
    features: str = "z, h"
    """What C sees: "z, h", or "z" or "h" alone, to find out what each of them is worth."""
    initial_gas: float = -0.5
    """Gas output of the first controller before squashing; (tanh(-0.5) + 1) / 2 is 27% gas."""
    patience: int = 100
    """In training, an episode that reaches no new tile for this many frames is ended; 0 for never."""
    max_frames: int = 1000
    """Frames of an episode in a search, in its looks or for a second round, at most; CarRacing's own limit is 1,000."""
    cars: int = 16
    """Cars that one process drives in step, at most, with one batch through V and M. Fewer keep more processes busy."""
    validate_every: int = 5
    """Generations between two looks at C so far on the validation tracks."""
    validation_tracks: int = 16
    """Tracks of such a look."""
    averaged_share: float = 0.4
    """Share of the generations, the last ones, whose CMA means are averaged into C; 0 for the last mean alone."""

    def __post_init__(self):
        for field in dataclasses.fields(self):
            check_value(field.name, field.type, getattr(self, field.name))
        if self.episode_frames <= self.stride:
            raise ValueError(
                f"episode_frames={self.episode_frames}, but with stride={self.stride} the first difference image"
                f" exists only after {self.stride} frames: use more than {self.stride} frames"
            )
        if self.generations % self.validate_every:
            raise ValueError(
                f"generations={self.generations} is not a multiple of validate_every={self.validate_every}: the last"
                " generation must be one that is validated"
            )
        if self.sigma_decay and self.sigma * self.sigma_decay**self.generations < SMALLEST_STEP:
            raise ValueError(
                f"sigma_decay={self.sigma_decay} shrinks sigma={self.sigma} below {SMALLEST_STEP} in {self.generations}"
                " generations: use a sigma_decay nearer to 1, or 0 for CMA-ES's own step size"
            )
        if self.m_sequence >= self.episode_frames:
            raise ValueError(
                f"m_sequence={self.m_sequence} does not fit into episodes of episode_frames={self.episode_frames}:"
                f" use at most {self.episode_frames - 1}"
            )

    @staticmethod
    def preset(name: str | None = None, /, **changes) -> "Settings":
        """Look up a preset by name.

        Args:
            name: "quick", "laptop" or "paper", by its place; None reads the environment variable STAD_LAB_SETTINGS,
                and takes "laptop" if that is not set.
            **changes: fields to set differently, for example `stride=2`; all but the name.

        Raises:
            ValueError: an unknown preset, an unknown field, or a value out of range.
        """
        name = name or os.environ.get(ENVIRONMENT_VARIABLE) or "laptop"
        if name not in PRESETS:
            raise ValueError(f"unknown settings {name!r}: choose one of {', '.join(PRESETS)}")
        if changes.get("name", name) != name:
            raise ValueError(
                f"name={changes['name']!r} of the settings {name!r}: the name cannot be set; choose a preset with"
                f" Settings.preset(NAME) or --settings NAME ({', '.join(PRESETS)})"
            )
        return dataclasses.replace(PRESETS[name], **known_fields(changes))

    def as_dict(self) -> dict:
        """All fields as a plain dict, for JSON."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: dict) -> "Settings":
        """The inverse of `as_dict`. Raises ValueError for unknown fields or values out of range."""
        return Settings(**known_fields(values))


NO_LESS_THAN_ZERO = (
    "seed",
    "evolution_seed",
    "patience",
    "kl_weight",
    "free_bits",
    "difference_weight",
    "m_steps",
    "agent_episodes",
    "components",
)
AT_LEAST = {"episodes": 2, "population": 4, "initial_gas": -100.0}
AT_MOST = {
    "episode_frames": 1000,  # CarRacing ends an episode then
    "max_frames": 1000,
    "processes": 10_000,  # beyond this and the next no machine has the room, and would say so only after hours
    "episodes": 1_000_000,
    "width": 1000,
    "latent_size": 10_000,
    "hidden_size": 10_000,
    "mixtures": 1000,
    "population": 100_000,
}
SMALLEST_STEP = 1e-12  # of the search; near 0 CMA-ES cannot compute
SHARES = ("random_starts", "revisited_share", "averaged_share", "sigma_decay")
FEATURES = ("z, h", "z", "h")


def check_value(name: str, kind: type, value: object) -> None:
    """Raise ValueError unless `value` is a sensible value of the field `name`."""
    if type(value) is not kind and not (kind is float and type(value) is int):
        raise ValueError(f"{name}={value!r} is a {type(value).__name__}: expected {kind.__name__}")
    if kind in (int, float):
        lowest = AT_LEAST.get(
            name, 0 if name in (*NO_LESS_THAN_ZERO, *SHARES) else 1 if kind is int else 1e-12
        )
        highest = AT_MOST.get(name, 1.0 if name in SHARES else 1e12)
        if not lowest <= value <= highest:
            raise ValueError(
                f"{name}={value!r} is out of range: expected {lowest:g} to {highest:g}"
            )
    if name == "name" and value not in ("quick", "laptop", "paper"):
        raise ValueError(
            f"name={value!r}: expected the preset that the settings began as, quick, laptop or paper"
        )
    if name == "features" and value not in FEATURES:
        raise ValueError(f"features={value!r}: choose one of {', '.join(map(repr, FEATURES))}")


def known_fields(values: dict) -> dict:
    """Return `values` unchanged, or raise ValueError if one of its keys is not a field of Settings."""
    fields = [field.name for field in dataclasses.fields(Settings)]
    for name in values:
        if name not in fields:
            raise ValueError(f"unknown setting {name!r}: the settings are {', '.join(fields)}")
    return values


MAY_CHANGE = ("name", "processes", "generations")  # between a run and its continuation


def check_same_run(path: Path, was: dict, now: dict) -> None:
    """Raise ValueError if the run in `path`, a folder or a file of it, was made with other values than `now` holds."""
    for name in now:
        if name not in MAY_CHANGE and was.get(name) != now[name]:
            raise ValueError(
                f"{path} holds a run with {name}={was.get(name)!r}, and now {name}={now[name]!r} is asked for:"
                " choose another folder, or the same variant and settings"
            )


PRESETS = {
    # The whole pipeline in under a minute: shows that everything works, teaches the car nothing.
    "quick": Settings(
        name="quick",
        episodes=8,
        episode_frames=60,
        width=8,
        v_steps=40,
        v_batch=32,
        hidden_size=24,
        m_steps=20,
        m_batch=8,
        m_sequence=24,
        generations=4,
        population=4,
        sigma_decay=0.0,
        components=0,
        max_frames=60,
        cars=4,
        validate_every=2,
        validation_tracks=2,
    ),
    # A car that drives, in less than half an hour on two fast cores.
    "laptop": Settings(),
    # The budget that the paper states, with World Models' sizes and loss, and its passes over the data: one for V,
    # twenty for M. What the paper leaves open is our reading: one episode for each agent, for example.
    "paper": Settings(
        name="paper",
        episodes=1000,
        episode_frames=1000,
        random_starts=0.0,
        width=32,
        kl_weight=1.0,
        free_bits=0.5,
        v_steps=10000,
        v_batch=100,
        m_steps=800,
        m_batch=50,
        m_sequence=500,
        m_learning_rate=1e-3,
        generations=600,
        population=8,
        sigma_decay=0.0,
        components=0,
        initial_gas=0.0,
        patience=0,
        validate_every=20,
        averaged_share=0.0,
    ),
}
