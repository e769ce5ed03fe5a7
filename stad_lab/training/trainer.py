"""One training loop for V and for M: Adam, a falling learning rate, a history, and a resume that changes nothing.

What happens in step s depends on (seed, s) and the weights alone: the caller draws step s's batch and noise from a
Generator seeded with both. So a run that was interrupted and resumed makes the same updates as one that was not: bit
for bit on the CPU, with as many threads, and nearly so on a GPU, whose convolutions add up in any order.
"""

import math
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from tqdm.auto import tqdm

from stad_lab.config import check_same_run
from stad_lab.io.files import load_into, load_tensors, save_tensors
from stad_lab.io.workers import keep_freed_memory, return_freed_memory

ENTRIES = 20  # of the history, and checkpoints, in a long run


def training_device() -> torch.device:
    """Where V and M are trained: on a CUDA GPU if there is one that computes, unless CUDA_VISIBLE_DEVICES hides it.

    Agents always drive on the CPU, in many processes.
    """
    if torch.cuda.is_available():
        try:
            torch.ones(1, device="cuda").add_(1).item()
            return torch.device("cuda")
        except (
            RuntimeError,
            AssertionError,
        ) as error:  # too old for this PyTorch, or others have taken all of it
            print(f"the GPU cannot be used, so V and M train on the CPU: {error}", file=sys.stderr)
    return torch.device("cpu")


def fit(
    model: torch.nn.Module,
    batch: Callable[[int], tuple],
    losses: Callable[..., dict[str, torch.Tensor]],
    heldout_losses: Callable[[], dict[str, float]],
    steps: int,
    learning_rate: float,
    checkpoint: Path,
    label: str,
    identity: dict,
    watch: Callable[[list[dict]], None] | None = None,
) -> list[dict]:
    """Train `model` in place for `steps` steps, or for those left after the checkpoint.

    Args:
        batch: step -> that step's batch, as `read_ahead` wants it.
        losses: the batch -> its named losses; "total" is minimised.
        heldout_losses: named losses on held-out data, computed without gradients.
        learning_rate: Adam's rate at the start; it falls to a tenth of it along a cosine. Gradients of a norm above 100
            are shortened to that.
        checkpoint: file of the training state, read if it exists, written with every entry of the history.
        label: what the progress bar says.
        identity: settings and checksums of all that the training depends on; a checkpoint of another one is refused.
        watch: called with the history so far, after the checkpoint of every entry and when a run is resumed.

    Returns:
        The history: entries {"step", "train": means since the last entry, "heldout"}, `steps // 20` steps apart.

    Raises:
        ValueError: the checkpoint belongs to another training or is damaged.
        FloatingPointError: the loss is not finite.
        OSError: the checkpoint cannot be written; the one before it is whole.
    """
    keep_freed_memory()
    optimizer = torch.optim.Adam(
        model.parameters(), lr=learning_rate, fused=True
    )  # one pass over the weights, not ten
    history = load_state(checkpoint, model, optimizer, identity) if checkpoint.exists() else []
    start, sums = history[-1]["step"] if history else 0, {}
    every = max(1, steps // ENTRIES)
    step = start
    try:
        if watch and history:
            watch(history)
        progress = tqdm(
            read_ahead(batch, range(start, steps)), label, steps, initial=start, unit="step"
        )
        for step, present in progress:
            found = losses(*present)
            values = {name: loss.item() for name, loss in found.items()}
            check_loss(values["total"], label, step)
            update(
                model,
                optimizer,
                found["total"],
                learning_rate * (0.55 + 0.45 * math.cos(math.pi * step / steps)),
            )
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + value
            if (step + 1) % every == 0 or step + 1 == steps:
                count = step + 1 - (history[-1]["step"] if history else 0)
                means = {name: total / count for name, total in sums.items()}
                heldout = heldout_losses()
                check_loss(
                    heldout["total"], label, step
                )  # after the last update no other would tell
                history.append({"step": step + 1, "train": means, "heldout": heldout})
                sums = {}
                progress.set_postfix(heldout=f"{heldout['total']:.4g}")
                save_state(checkpoint, model, optimizer, history, identity)
                if watch:
                    watch(history)
    except KeyboardInterrupt:
        # The interrupt may have come in mid-update; the checkpoint of the last record is whole, so it stays.
        print(
            f"{label}: interrupted in step {step}; run the same again to go on from the last checkpoint"
        )
        raise
    return history


def check_loss(total: float, label: str, step: int) -> None:
    """Raise FloatingPointError unless a loss is finite."""
    if not math.isfinite(total):
        raise FloatingPointError(
            f"{label}: the loss is {total} in step {step}: lower the learning rate, in a new folder"
        )


def update(
    model: torch.nn.Module, optimizer: torch.optim.Optimizer, total: torch.Tensor, rate: float
) -> None:
    """One step of Adam against the gradient of `total`, which is shortened to a norm of 100."""
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.zero_grad(set_to_none=True)
    total.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), 100.0)
    optimizer.step()
    return_freed_memory()


def read_ahead(batch: Callable[[int], tuple], steps: range) -> Iterator[tuple[int, tuple]]:
    """Every step with its batch, which a thread has read while the step before was trained."""
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(batch, steps.start) if steps else None
        for step in steps:
            present, following = (
                following,
                reader.submit(batch, step + 1) if step + 1 < steps.stop else None,
            )
            yield step, present.result()


def save_state(
    path: Path,
    model: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    history: list,
    identity: dict,
) -> None:
    """Write everything the next step depends on: weights, Adam's moments, and the history, which says where we are."""
    tensors = {f"model.{name}": tensor for name, tensor in model.state_dict().items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{number}.{name}": tensor for name, tensor in moments.items()}
    save_tensors(path, tensors, history=history, identity=identity)


def load_state(
    path: Path, model: torch.nn.Module, optimizer: torch.optim.Optimizer, identity: dict
) -> list:
    """Restore what `save_state` wrote into `model` and `optimizer`; returns the history.

    Raises:
        ValueError: the file is damaged, or of a training of another identity.
    """
    tensors, facts = load_tensors(
        path, "run the same command again, which trains this part from its start"
    )
    check_same_run(path, facts["identity"], identity)
    weights = {name[6:]: tensor for name, tensor in tensors.items() if name.startswith("model.")}
    load_into(model, weights, path)
    state, parameters = optimizer.state_dict(), list(model.parameters())
    for name, tensor in tensors.items():
        if name.startswith("adam."):
            number, moment = int(name.split(".")[1]), name.split(".")[2]
            if (
                tensor.shape == parameters[number].shape
            ):  # a moment, and it must lie in memory as its weights do
                tensor = torch.empty_like(parameters[number]).copy_(tensor)
            state["state"].setdefault(number, {})[moment] = tensor
    optimizer.load_state_dict(state)
    return facts["history"]
