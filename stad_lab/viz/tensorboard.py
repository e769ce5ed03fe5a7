"""A run in TensorBoard, while it goes on: losses, returns, step size, latents and films."""

import functools
import shutil
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stad_lab.agent import load_agent
from stad_lab.envs.frames import normalise
from stad_lab.evaluation.trajectories import (
    MOTION,
    Trajectory,
    encode_trajectory,
    record_trajectory,
)
from stad_lab.io.weights import CONTROLLER_FILE, WorldModel
from stad_lab.models.vae import to_tensor
from stad_lab.training.evolution import fitness_curves
from stad_lab.viz.video import FILM, film_agent

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

FRAMES = 400  # of the episode whose latents are shown


class TensorBoard:
    """Writes what `train` tells it to `folder`, whose earlier events are replaced.

    A resumed run tells its history from the start, so the curves are whole. ImportError, with the
    remedy, if TensorBoard is not installed; ValueError if the folder holds something else.
    """

    def __init__(self, folder: Path):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            remedy = "--tensorboard needs it: pip install 'stad_lab[tensorboard]'"
            raise ImportError(f"TensorBoard is not installed; {remedy}") from error
        there = list(folder.glob("*"))
        if there and not any(folder.glob("events.out.tfevents.*")):
            raise ValueError(f"{folder}: not of TensorBoard, and would be replaced: move it")
        self.folder, self.open, self.written = folder, SummaryWriter, Counter[str]()

    @functools.cached_property
    def writer(self) -> "SummaryWriter":
        """Opened with the first entry, so that a training which is refused erases nothing."""
        if self.folder.exists():
            shutil.rmtree(self.folder)
        return self.open(str(self.folder))

    def __call__(self, stage: str, entries: list[dict]) -> None:
        """Add what is new in a stage's history, or in the generations of CMA-ES."""
        for entry in entries[self.written[stage] :]:
            number = entry["generation" if stage == "controller" else "step"]
            values = returns_of(entry) if stage == "controller" else losses_of(entry)
            for name, value in values.items():
                self.writer.add_scalar(f"{stage}/{name}", value, number)
        self.written[stage] = len(entries)
        self.writer.flush()

    def add_agent(self, folder: Path) -> None:
        """Add the film of a run's agent and the latents of its episode, if there is an agent."""
        if not self.written:
            return  # no stage has told anything: earlier curves would be erased for nothing
        if (folder / CONTROLLER_FILE).exists():
            agent = load_agent(folder)
            self.add_film("agent", film_agent(agent, **FILM))
            self.add_latents(agent.world_model, record_trajectory(agent, FILM["track"], FRAMES))
        self.writer.close()

    def add_film(self, name: str, gif: bytes) -> None:
        """Add an animated GIF, which TensorBoard shows under *Images*."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        image = Summary.Image(encoded_image_string=gif, colorspace=3)
        summary = Summary(value=[Summary.Value(tag=name, image=image)])
        self.writer._get_file_writer().add_summary(summary)  # add_video would need moviepy

    def add_latents(self, world_model: WorldModel, trajectory: Trajectory) -> None:
        """Add z of each frame, with the frame and the car's motion, to the *Projector*."""
        vae, _, stride, crop_bar, _ = world_model
        mu, _ = encode_trajectory(vae, trajectory, stride, crop_bar)
        pictures = to_tensor(normalise(trajectory.frames(crop_bar)))
        motion = [[f"{value:.2f}" for value in row] for row in trajectory.motion]
        names = list(MOTION)
        self.writer.add_embedding(mu, motion, pictures, metadata_header=names, tag="z")


def losses_of(entry: dict) -> dict[str, float]:
    """The losses of an entry of a training's history: "train/total", "heldout/total", ..."""
    return {
        f"{data}/{name}": value
        for data in ("train", "heldout")
        for name, value in entry[data].items()
    }


def returns_of(entry: dict) -> dict[str, float]:
    """Returns and step size of a generation."""
    worst, mean, best = np.ravel(fitness_curves([entry]))
    values = {"worst": worst, "mean": mean, "best": best, "sigma": entry["sigma"]}
    if entry.get("validation"):
        values["validation"] = entry["validation"]["mean"]
    return values
