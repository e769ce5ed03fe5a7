"""Study 2 of docs/protocol.md: does `frame` reach the paper's baseline with the paper's budget?

V and M are trained as the paper says, once for each seed and variant, and kept in 16 bits. With
them C is evolved over 600 generations of 8 candidates, each of which drives 1, 4 or 16 episodes:
the paper does not say how many. In the folder of the study::

    seed300/dataset/            of the random driver
    seed300/frame/              V and M
    seed300/frame/4/            a run: the log of CMA-ES, and the score

A gate comes first, with `frame` alone. What follows depends on its outcome.
"""

from pathlib import Path
from typing import NamedTuple

from stad_lab.config import Config
from stad_lab.io.files import copy_file, load_json, locked, save_json
from stad_lab.io.weights import MDN_RNN_FILE, VAE_FILE, load_mdn_rnn, load_vae
from stad_lab.training.pipeline import train
from stad_lab.training.record import RECORD
from stad_lab.training.trainer import training_device
from stad_study import tables
from stad_study.evolved import Evolved
from stad_study.networks import WORLD_MODEL_FILE, keep_world_model, load_kept_world_model
from stad_study.senses import Sense

SEEDS = range(300, 305)
PASSED = 780.0  # points that each run of the gate must reach
GATE = {4: SEEDS[:2], 1: SEEDS[:2], 16: SEEDS[:1]}  # episodes of a candidate -> seeds
CONFIG = Config.preset("paper", processes=1)
LOSSES = "training.json"  # what the files of V and M say of their training
TRAINING = 6 * 3600.0  # seconds to wait for another process that trains V and M


class Run(NamedTuple):
    """One C; its name is also its folder."""

    seed: int
    variant: str
    episodes: int  # that each candidate drives in a generation

    @property
    def name(self) -> str:
        """For example "seed300/frame/4"."""
        return f"seed{self.seed}/{self.variant}/{self.episodes}"

    @property
    def config(self) -> Config:
        """Its configuration. Candidates and tracks depend on seed and episodes alone."""
        evolution = {"seed": self.seed, "tracks": self.episodes}
        return CONFIG.replace(variant=self.variant, seed=self.seed, evolution=evolution)


def parts_of_study2(to: Path = tables.DATA) -> dict[str, list[Run]]:
    """Part -> its runs, as far as the tables in `to` decide them."""
    gates = {episodes: has_passed(episodes, to) for episodes in GATE}
    asked = [4, 1] + [16] * (gates[4] is False)
    parts = {
        f"gate, {episodes} each": [Run(seed, "frame", episodes) for seed in GATE[episodes]]
        for episodes in asked
    }
    passed = [episodes for episodes in asked if gates[episodes]]
    if passed and None not in (gates[4], gates[1]):
        parts["after the gate"] = after_gate(min(passed))
    return parts


def has_passed(episodes: int, to: Path = tables.DATA) -> bool | None:
    """Whether all runs of the gate at so many episodes reached PASSED; None before the last."""
    table = tables.read_or_empty("study2_runs", to)
    own = table[(table["variant"] == "frame") & (table["episodes"] == episodes)]
    own = own[own["seed"].isin(GATE[episodes])]
    return bool((own["mean"] >= PASSED).all()) if len(own) == len(GATE[episodes]) else None


def after_gate(episodes: int) -> list[Run]:
    """What the protocol allows after the gate was passed with so many episodes."""
    pairs, others = ("frame", "input_output"), ("input", "output")
    arms = [(seed, one) for seed in (SEEDS if episodes < 16 else SEEDS[:2]) for one in pairs]
    arms += [(seed, one) for seed in SEEDS[:2] for one in others if episodes < 16]
    return [Run(*arm, episodes) for arm in arms if (*arm, episodes) not in gate_runs()]


def gate_runs() -> list[Run]:
    """All runs that the gate may have."""
    return [Run(seed, "frame", episodes) for episodes, seeds in GATE.items() for seed in seeds]


def prepare(run: Run, root: Path, networks: Path) -> Sense:
    """What C drives with; trains V and M if they are not kept yet."""
    kept = networks / "study2" / f"seed{run.seed}" / run.variant / WORLD_MODEL_FILE
    if not kept.exists():
        check_device(kept.parents[1])
        train_world(run, root / f"seed{run.seed}", kept)
    return Sense(load_kept_world_model(kept), "z, h")


def check_device(seed: Path) -> None:
    """Raise ValueError if V and M of another variant of the seed are not of this kind of device."""
    for file in seed.glob(f"*/{RECORD}"):
        device = load_json(file)["made_with"]["trained_on"].split(",")[0]
        if device != training_device().type:
            remedy = "train those of all its variants on one kind of device"
            raise ValueError(f"V and M of {file.parent} were trained on {device}: {remedy}")


def train_world(run: Run, seed: Path, kept: Path) -> None:
    """Train V and M of a seed and variant in the folder `seed`; keep them, record and losses."""
    config, folder = run.config, seed / run.variant
    with locked(seed, TRAINING):
        train(config, folder, seed / "dataset", until="mdn_rnn")
    copy_file(folder / RECORD, kept.parent)
    losses = {
        "vae": load_vae(folder / VAE_FILE)[1],
        "mdn_rnn": load_mdn_rnn(folder / MDN_RNN_FILE)[1],
    }
    save_json(kept.with_name(LOSSES), losses)
    keep_world_model(config, folder, kept)  # last: a world is complete if it is there


STUDY2 = Evolved("study2", parts_of_study2, prepare, keeps_logs=True)
