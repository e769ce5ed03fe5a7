"""The configuration of a run: one frozen dataclass for each stage, and four presets.

`Config.preset("laptop")` is the default; `quick` shows in a minute that everything works, `fast`
trains V and M on less than `laptop` does, and `paper` is the budget that the paper states. A run's
configuration is written into its folder. A stage depends on no later one: another step size of
CMA-ES leaves a trained V valid.

The docstring below each field is its help on the command line. A field that is added later needs a
default that means what the code did before, so that older runs stay valid.
"""

import dataclasses
import os
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

PRESET_VARIABLE = "STAD_LAB_PRESET"
VARIANTS = ("frame", "input", "output", "input_output")  # those of the paper
SMALLEST_SIGMA = 1e-12  # near 0 CMA-ES cannot compute

# (lowest, highest) value of fields; any other int is at least 1, any other float above 0.
BOUNDS = {
    (0, 1): "data.random_starts evolution.averaged_share evolution.replay_share"
    " evolution.sigma_decay",
    (0, 1e12): "data.agent_patience evolution.components evolution.patience mdn_rnn.steps"
    " vae.difference_weight vae.free_bits vae.kl_weight",
    (-100, 1e12): "evolution.initial_gas",
    (0, 1_000_000): "data.agent_episodes",
    (0, 2**63): "seed evolution.seed",
    (1, 1000): "data.agent_frames data.episode_frames evolution.max_frames mdn_rnn.mixtures"
    " vae.width",  # CarRacing ends an episode after 1,000 frames
    (1, 10_000): "mdn_rnn.hidden_size processes vae.latent_size",
    (2, 1_000_000): "data.episodes",  # one to train on, one held out
    (4, 100_000): "evolution.population",
}
RANGES = {name: bounds for bounds, names in BOUNDS.items() for name in names.split()}


@dataclass(frozen=True)
class DataConfig:
    """The dataset: what is driven for it, and how a frame is made."""

    episodes: int = 900
    """Episodes of the random driver."""
    episode_frames: int = 120
    """Frames of such an episode, at most. A random driver soon leaves the road."""
    random_starts: float = 0.9
    """Share of these episodes that start moving, on a random tile, instead of at rest on tile 0."""
    crop_bar: bool = True
    """Cut off the indicator bar (the lowest 12 of 96 rows), as World Models does."""
    agent_episodes: int = 0
    """Episodes that the agent of an earlier run drives, in a second iteration; 0 in the first."""
    agent_frames: int = 1000
    """Frames of an agent's episode, at most."""
    agent_patience: int = 100
    """Maximum number of frames without a new tile in an agent's episode; 0 for no limit."""


@dataclass(frozen=True)
class VAEConfig:
    """V, the variational autoencoder."""

    latent_size: int = 32
    """Dimensions of z."""
    width: int = 16
    """Channels of the first convolution; the others follow from it. World Models has 32."""
    stride: int = 4
    """k of the difference image d_t = x_t - x_(t-k), in frames."""
    kl_weight: float = 0.25
    """Weight of the KL term beside the squared error. World Models has 1."""
    free_bits: float = 0.0
    """Nats for each latent below which the KL is not penalised. World Models has 0.5."""
    difference_weight: float = 1.0
    """Weight of the difference image's squared error, in the variants that reconstruct it."""
    steps: int = 5000
    """Training steps."""
    batch: int = 128
    """Frames in a batch."""
    learning_rate: float = 1e-3
    """Adam's learning rate at the start; it falls to a tenth along a cosine."""


@dataclass(frozen=True)
class MDNRNNConfig:
    """M, the MDN-RNN."""

    hidden_size: int = 256
    """Units of the LSTM."""
    mixtures: int = 5
    """Gaussians in the mixture of each latent dimension."""
    steps: int = 1500
    """Training steps; 0 leaves M untrained."""
    batch: int = 64
    """Sequences in a batch."""
    sequence: int = 100
    """Frames in a sequence."""
    learning_rate: float = 2e-3
    """Adam's learning rate at the start; it falls to a tenth along a cosine."""


@dataclass(frozen=True)
class EvolutionConfig:
    """C, evolved by CMA-ES."""

    seed: int = 0
    """Seed of the candidates and of the tracks: several CMA-ES runs may share one V and M."""
    generations: int = 55
    """Generations of CMA-ES; a finished run may be continued with more."""
    population: int = 64
    """Candidates in a generation."""
    tracks: int = 1
    """Tracks that each candidate drives in a generation, the same for all."""
    replay_share: float = 0.0
    """Share of the tracks that are hard earlier ones instead of new ones."""
    sigma: float = 0.1
    """Initial step size."""
    sigma_decay: float = 0.97
    """Factor on the step size in each generation; 0 leaves the step size to CMA-ES."""
    step_size_rule: Literal["CSA", "TPA"] = "CSA"
    """How CMA-ES adapts sigma: cumulative step-size adaptation (World Models) or two-point."""
    components: int = 48
    """Optimise at most this many principal components of what C sees; 0 for every weight."""
    features: Literal["z, h", "z", "h"] = "z, h"
    """What C sees: "z, h" with its quotes, z or h."""
    initial_gas: float = -0.5
    """Gas output of the first controller before squashing; (tanh(-0.5) + 1) / 2 is 27% gas."""
    patience: int = 100
    """Maximum number of frames without a new tile in a training episode; 0 for no limit."""
    max_frames: int = 1000
    """Frames of a training or validation episode, at most."""
    cars: int = 16
    """Cars that drive in one batch, at most. Fewer keep more threads busy."""
    validate_every: int = 5
    """Generations between two validations of the averaged CMA mean."""
    validation_tracks: int = 16
    """Tracks of a validation."""
    averaged_share: float = 0.4
    """Share of the generations, the last ones, whose means are averaged into C; 0 for the last."""


@dataclass(frozen=True)
class Config:
    """Everything that determines a run. The defaults are the `laptop` preset.

    Raises:
        ValueError: a value of the wrong type, out of range, or that does not fit another one.
    """

    variant: Literal["frame", "input", "output", "input_output"] = "input_output"
    """Which pictures V sees and reconstructs; `frame` is World Models without difference images."""
    seed: int = 0
    """Seed of the dataset, of the initial weights and of the training."""
    processes: int = 2
    """Workers that drive; the results do not depend on their number."""
    data: DataConfig = field(default_factory=DataConfig)
    vae: VAEConfig = field(default_factory=VAEConfig)
    mdn_rnn: MDNRNNConfig = field(default_factory=MDNRNNConfig)
    evolution: EvolutionConfig = field(default_factory=EvolutionConfig)

    def __post_init__(self):
        for name, kind, value in fields_of(self):
            check_value(name, kind, value)
        check_together(self)

    @staticmethod
    def preset(name: str | None = None, /, **changes) -> "Config":
        """Look up a preset and change some fields, as `replace` does.

        Args:
            name: "quick", "fast", "laptop" or "paper"; None reads the environment variable
                STAD_LAB_PRESET, and takes "laptop" if that is not set.
            **changes: as for `replace`.

        Raises:
            ValueError: an unknown preset or field, or a value that `Config` refuses.
        """
        if name is None:
            name = os.environ.get(PRESET_VARIABLE) or "laptop"
        if not isinstance(name, str) or name not in PRESETS:
            found = " ".join(repr(name).split())
            raise ValueError(f"unknown preset {found}: choose one of {', '.join(PRESETS)}")
        return PRESETS[name].replace(**changes)

    def replace(self, **changes) -> "Config":
        """A copy with changes: `replace(seed=1, vae={"stride": 2})`. ValueError as `preset`."""
        return with_values(self, changes)

    def as_dict(self) -> dict:
        """All fields as nested dicts, for JSON."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: dict) -> "Config":
        """The inverse of `as_dict`; a missing field has its default. ValueError as `preset`."""
        return with_values(Config(), values)


def with_values(base: Any, values: dict) -> Any:
    """A copy of the dataclass `base` with values of a nested dict. ValueError as `preset`."""
    known, changed = [one.name for one in dataclasses.fields(base)], {}
    if not isinstance(values, dict):
        raise ValueError(f"settings of type {type(values).__name__}: expected a dict")
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"unknown setting {name!r}: expected one of {', '.join(known)}")
        stage = getattr(base, name)
        nested = isinstance(value, dict) and dataclasses.is_dataclass(stage)
        changed[name] = with_values(stage, value) if nested else value
    return dataclasses.replace(base, **changed)


def fields_of(config: Any, prefix: str = "") -> list[tuple[str, Any, Any]]:
    """(dotted name, type, value) of every field. ValueError for a stage of another type."""
    found = []
    for one in dataclasses.fields(config):
        name, value = prefix + one.name, getattr(config, one.name)
        kind: Any = one.type
        if not dataclasses.is_dataclass(one.type):
            found.append((name, kind, value))
        elif isinstance(value, kind):
            found += fields_of(value, f"{name}.")
        else:
            raise ValueError(f"{name}={value!r}: expected a {kind.__name__} or a dict of it")
    return found


def check_value(name: str, kind: Any, value: Any) -> None:
    """Raise ValueError unless `value` is a valid value of the field `name`."""
    shown = " ".join(repr(value).split())  # an array has several lines
    if choices := typing.get_args(kind):
        if not isinstance(value, str) or value not in choices:
            raise ValueError(f"{name}={shown}: choose one of {', '.join(map(repr, choices))}")
        return
    if type(value) is not kind and not (kind is float and type(value) is int):
        raise ValueError(f"{name}={shown} is a {type(value).__name__}: expected {kind.__name__}")
    if kind in (int, float):
        low, high = RANGES.get(name, (1 if kind is int else SMALLEST_SIGMA, 1e12))
        if not low <= value <= high:
            raise ValueError(f"{name}={value!r} is out of range: expected {low:g} to {high:g}")


def check_together(config: Config) -> None:
    """Raise ValueError for values that are valid alone but not together."""
    frames, stride = config.data.episode_frames, config.vae.stride
    sequence, evolution = config.mdn_rnn.sequence, config.evolution
    if frames <= stride:
        raise ValueError(f"data.episode_frames={frames}: expected more than vae.stride={stride}")
    if sequence >= frames:
        raise ValueError(
            f"mdn_rnn.sequence={sequence} does not fit into episodes of"
            f" data.episode_frames={frames}: use at most {frames - 1}"
        )
    if evolution.generations % evolution.validate_every:
        raise ValueError(
            f"evolution.generations={evolution.generations} is not a multiple of"
            f" evolution.validate_every={evolution.validate_every}: the last must be validated"
        )
    last_sigma = evolution.sigma * evolution.sigma_decay**evolution.generations
    if evolution.sigma_decay and last_sigma < SMALLEST_SIGMA:
        raise ValueError(
            f"evolution.sigma_decay={evolution.sigma_decay} shrinks sigma={evolution.sigma} below"
            f" {SMALLEST_SIGMA} in {evolution.generations} generations: use one nearer to 1, or 0"
        )


def check_same(path: Path, was: dict, now: dict) -> None:
    """Raise ValueError if what is in `path` was made with other values than `now` asks for.

    Both are nested dicts. A setting that `was` lacks did not exist then: it counts as its default.
    """
    then, now, defaults = flatten(was), flatten(now), flatten(Config().as_dict())
    for name, value in now.items():
        if (before := then.get(name, defaults.get(name))) != value:
            raise ValueError(
                f"{path} was made with {name}={before!r}, now {name}={value!r} is asked for:"
                " choose another folder, or the same settings"
            )


def flatten(values: dict, prefix: str = "") -> dict:
    """A nested dict as a flat one with dotted names: {"a": {"b": 1}} -> {"a.b": 1}."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        nested = isinstance(value, dict)
        flat |= flatten(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return flat


# The purposes that random numbers are drawn for. Each has its own stream; append, never reorder.
STREAMS = (
    "tracks", "random driver", "agent driver", "order", "init", "vae", "mdn_rnn", "evolution",
    "heldout", "bootstrap",
)  # fmt: skip


def random_stream(purpose: str, seed: int, *numbers: int) -> np.random.Generator:
    """A Generator for one of STREAMS: equal arguments give equal numbers, others independent."""
    key = (STREAMS.index(purpose), *numbers)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


# A track is named by the seed of `env.reset`. The uses never share one: an agent is evaluated on
# tracks that nothing was trained or chosen on, and V and M on tracks that they have not seen.
TRACK_RANGES = {
    "test": (0, 1_000_000),
    "collect": (1_000_000, 2_000_000),
    "evolve": (2_000_000, 3_000_000),
    "validate": (3_000_000, 4_000_000),
    "inspect": (4_000_000, 5_000_000),
}

# Of the tracks for tests: those of a reported evaluation, and of the studies' scores.
REPORTED_TRACKS, STUDY_TRACKS = range(100), range(1000, 1400)


def track_seeds(use: str, count: int, seed: int = 0, *numbers: int) -> list[int]:
    """Seeds of `count` tracks from the range of one use, drawn with a seed and further numbers.

    A track may be drawn twice. ValueError for a use that is not in TRACK_RANGES.
    """
    rng = random_stream("tracks", seed, list(TRACK_RANGES).index(use), *numbers)
    return rng.integers(*TRACK_RANGES[use], count).tolist()


PRESETS = {
    # The whole pipeline in under a minute: shows that everything works, teaches the car nothing.
    "quick": Config(
        data=DataConfig(episodes=8, episode_frames=60, agent_frames=60),
        vae=VAEConfig(width=8, steps=40, batch=32),
        mdn_rnn=MDNRNNConfig(hidden_size=24, steps=20, batch=8, sequence=24),
        evolution=EvolutionConfig(
            generations=4,
            population=4,
            sigma_decay=0.0,
            components=0,
            max_frames=60,
            cars=4,
            validate_every=2,
            validation_tracks=2,
        ),
    ),
    # Trains V on a quarter of the pictures of `laptop`, and M on a third of the sequences, in small
    # batches, of which a CPU learns more in the same time. Study 6 of docs/protocol.md could not
    # rule out that it costs 30 points.
    "fast": Config(
        vae=VAEConfig(steps=5500, batch=32),
        mdn_rnn=MDNRNNConfig(steps=2000, batch=16, learning_rate=1.5e-3),
        evolution=EvolutionConfig(generations=40, sigma_decay=0.96),
    ),
    # A car that drives, in less than half an hour on two fast cores.
    "laptop": Config(),
    # The budget that the paper states, with World Models' sizes and loss, and its passes over the
    # data: one for V, twenty for M. The paper does not say how many episodes a candidate drives.
    # With one `frame` stayed far below its score, with four it came near (study 2 of
    # docs/protocol.md).
    "paper": Config(
        data=DataConfig(episodes=1000, episode_frames=1000, random_starts=0.0),
        vae=VAEConfig(width=32, kl_weight=1.0, free_bits=0.5, steps=10000, batch=100),
        mdn_rnn=MDNRNNConfig(steps=800, batch=50, sequence=500, learning_rate=1e-3),
        evolution=EvolutionConfig(
            generations=600,
            population=8,
            tracks=4,
            sigma_decay=0.0,
            components=0,
            initial_gas=0.0,
            patience=0,
            validate_every=20,
            averaged_share=0.0,
        ),
    ),
}
