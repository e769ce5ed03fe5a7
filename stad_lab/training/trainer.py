"""One training loop for V and for M: Adam, a falling learning rate, checkpoints and a history.

Step s depends on the seed, s, the weights and Adam's moments alone, because its batch is drawn from
a Generator of its own. So a resumed training makes the same updates as an uninterrupted one:
bit-identical on the CPU with as many threads, and nearly so on a GPU.
"""

import contextlib
import math
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.optim import Adam
from tqdm.auto import tqdm

from stad_lab.config import random_stream
from stad_lab.io.files import load_into, save_tensors
from stad_lab.io.memory import keep_freed_memory, return_freed_memory
from stad_lab.io.weights import load_training
from stad_lab.io.workers import interrupted_at_the_end

ENTRIES = 20  # of the history, and checkpoints, at least, in a training
LARGEST_NORM = 100.0  # of the gradient, which is shortened to it
LAST_RATE = 0.1  # learning rate at the end, as a share of that at the start

Watch = Callable[[list[dict]], None]
"""Called with a history after every entry, and first with what was there before."""


@dataclass
class Training:
    """What is trained, on what, and where its state is kept."""

    model: nn.Module
    batch: Callable[[int], tuple]  # step -> the arguments of `losses`
    losses: Callable[..., dict[str, torch.Tensor]]  # by name; "total" is minimised
    heldout_losses: Callable[[], dict[str, float]]  # by the same names
    steps: int
    learning_rate: float
    checkpoint: Path
    made_with: dict  # configuration and checksums of all that the training depends on
    label: str  # of the progress bar
    watch: Watch | None = None


def fit(training: Training) -> list[dict]:
    """Train the model in place, or continue from the checkpoint; returns the history.

    Its entries are {"step", "train": mean losses since the last entry, "heldout"}.

    Raises:
        ValueError: the checkpoint belongs to another training or is damaged.
        FloatingPointError: the loss is not finite.
        OSError: the checkpoint cannot be written; the one before it is whole.
    """
    keep_freed_memory()
    # fused: one pass over the weights instead of ten
    optimizer = Adam(training.model.parameters(), lr=0.0, fused=True)
    history = load_state(training, optimizer) if training.checkpoint.exists() else []
    start, steps = history[-1]["step"] if history else 0, training.steps
    every, sums, step = max(1, steps // ENTRIES), Counter[str](), start
    if training.watch and history:
        training.watch(history)
    batches = read_ahead(training.batch, range(start, steps))
    progress = tqdm(batches, training.label, steps, initial=start, unit="step")
    try:
        for step, batch in progress:
            losses = training.losses(*batch)
            check_finite(losses["total"].item(), training.label, step)
            update(training.model, optimizer, losses["total"], learning_rate(training, step))
            sums.update({name: loss.item() for name, loss in losses.items()})
            if (step + 1) % every == 0 or step + 1 == steps:
                history.append(entry(training, step, history, sums))
                sums.clear()
                progress.set_postfix(heldout=f"{history[-1]['heldout']['total']:.4g}")
                save_state(training, optimizer, history)
                return_freed_memory()
                if training.watch:
                    training.watch(history)
    except KeyboardInterrupt:
        print(f"{training.label}: interrupted in step {step}; the same call continues")
        raise
    return history


def entry(training: Training, step: int, history: list[dict], sums: Mapping[str, float]) -> dict:
    """The history's entry after a step, from the sums of the losses since the last entry."""
    count = step + 1 - (history[-1]["step"] if history else 0)
    with torch.no_grad():
        heldout = training.heldout_losses()
    check_finite(heldout["total"], training.label, step)  # the last update has no other check
    means = {name: total / count for name, total in sums.items()}
    return {"step": step + 1, "train": means, "heldout": heldout}


def learning_rate(training: Training, step: int) -> float:
    """Adam's learning rate in a step: it falls to LAST_RATE of the first along a cosine."""
    falling = 0.5 * (1 + math.cos(math.pi * step / training.steps))
    return training.learning_rate * (LAST_RATE + (1 - LAST_RATE) * falling)


def update(model: nn.Module, optimizer: Adam, total: torch.Tensor, rate: float) -> None:
    """One step of Adam against the gradient of `total`."""
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.zero_grad(set_to_none=True)
    total.backward()
    nn.utils.clip_grad_norm_(model.parameters(), LARGEST_NORM)
    optimizer.step()


def check_finite(total: float, label: str, step: int) -> None:
    """Raise FloatingPointError unless a loss is finite."""
    if not math.isfinite(total):
        remedy = "lower the learning rate, in a new folder"
        raise FloatingPointError(f"{label}: the loss is {total} in step {step}: {remedy}")


def read_ahead(batch: Callable[[int], tuple], steps: range) -> Iterator[tuple[int, tuple]]:
    """Every step with its batch, which a thread reads while the step before is trained."""
    with ThreadPoolExecutor(1) as reader:
        following: Any = reader.submit(batch, steps.start) if steps else None
        for step in steps:
            with interrupted_at_the_end():  # in these calls it leaves a lock that nobody releases
                ready = following.result()
                following = reader.submit(batch, step + 1) if step + 1 < steps.stop else None
            yield step, ready


@contextlib.contextmanager
def torch_settings(seed: int, number: int) -> Iterator[torch.device]:
    """Seed torch for a `with` block that trains model `number` (V: 0, M: 1); yields its device.

    On a GPU, too, sums are float32. The caller's random state, default dtype and gradient mode are
    the same afterwards.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # or sums of an LSTM may differ
    exact = torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False)
    device, dtype = training_device(), torch.get_default_dtype()
    own_stream = torch.random.fork_rng([device] if device.type == "cuda" else [])
    torch.set_default_dtype(torch.float32)
    try:
        with exact, own_stream, torch.enable_grad():
            torch.manual_seed(int(random_stream("init", seed, number).integers(2**63)))
            yield device
    finally:
        torch.set_default_dtype(dtype)


def training_device() -> torch.device:
    """A CUDA GPU if one computes and CUDA_VISIBLE_DEVICES does not hide it; otherwise the CPU."""
    if torch.cuda.is_available():
        try:
            torch.ones(1, device="cuda").add_(1).item()
            return torch.device("cuda")
        except (RuntimeError, AssertionError) as error:  # too old for this PyTorch, or in use
            print(f"V and M train on the CPU, the GPU cannot be used: {error}", file=sys.stderr)
    return torch.device("cpu")


def save_state(training: Training, optimizer: Adam, history: list) -> None:
    """Write everything the next step depends on: weights, Adam's moments and the history."""
    tensors = {f"model.{name}": value for name, value in training.model.state_dict().items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{number}.{name}": value for name, value in moments.items()}
    metadata = {"kind": "training", "history": history, "made_with": training.made_with}
    save_tensors(training.checkpoint, tensors, **metadata)


def load_state(training: Training, optimizer: Adam) -> list[dict]:
    """Restore what `save_state` wrote into the model and the optimizer; returns the history."""
    path = training.checkpoint
    tensors, metadata = load_training(path, training.made_with)
    weights = {name[6:]: value for name, value in tensors.items() if name.startswith("model.")}
    load_into(training.model, weights, path)
    state, parameters = optimizer.state_dict(), list(training.model.parameters())
    for name, tensor in tensors.items():
        if name.startswith("adam."):
            number, moment = int(name.split(".")[1]), name.split(".")[2]
            if tensor.shape == parameters[number].shape:  # it must lie in memory as its weights do
                tensor = torch.empty_like(parameters[number]).copy_(tensor)
            state["state"].setdefault(number, {})[moment] = tensor
    optimizer.load_state_dict(state)
    return metadata["history"]
