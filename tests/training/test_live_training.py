"""Training in a real kernel: the stop button ends a cell in one line, and the same cell goes on, bit for bit."""

import os
import re
import shutil

import pytest
from jupyter_client.manager import start_new_kernel
from safetensors.torch import load_file

from stad_lab import Settings
from stad_lab.models.vae import train_autoencoder

TRAIN = """
from pathlib import Path
from stad_lab import Settings
from stad_lab.models.vae import train_autoencoder
from stad_lab.viz.plots import plot_history
from stad_lab.viz.widgets import watch_training
settings = Settings.preset("quick", v_steps=20)
draw = lambda history: plot_history(history, f"step {history[-1]['step']}", "loss")
folder = Path(FOLDER)
train = lambda watch: train_autoencoder("frame", settings, folder.parent / "rollouts", folder, watch)
print("complete:", watch_training(train, draw))
"""


@pytest.fixture(scope="module")
def kernel():
    """A kernel as JupyterLab starts it: (manager, client)."""
    manager, client = start_new_kernel(
        kernel_name="python3", env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    yield manager, client
    client.stop_channels()
    manager.shutdown_kernel(now=True)


def run_cell(kernel, code, interrupt_after=None):
    """Run a cell, pressing stop after so many figures: (what it printed, its figures, its error or None)."""
    manager, client = kernel
    figures, printed = [], []

    def take(message):
        content = message["content"]
        if message["msg_type"] in ("display_data", "update_display_data") and "<img" in content[
            "data"
        ].get("text/html", ""):
            figures.append(content["data"]["text/html"])
            if len(figures) == interrupt_after:
                manager.interrupt_kernel()
        if message["msg_type"] == "stream" and content["name"] == "stdout":
            printed.append(content["text"])

    reply = client.execute_interactive(code, output_hook=take, timeout=120)["content"]
    return "".join(printed), figures, None if reply["status"] == "ok" else reply["ename"]


def step_of(figure):
    """How many steps a figure shows, by its alternative text."""
    return int(re.search(r'alt="step (\d+)', figure)[1])


def test_a_training_that_was_stopped_in_its_cell_goes_on_to_the_last_bit(
    kernel, quick_run, tmp_path
):
    settings = Settings.preset("quick", v_steps=20)
    shutil.copytree(quick_run / "rollouts", tmp_path / "rollouts")
    stopped, straight = tmp_path / "stopped", tmp_path / "straight"
    for folder in (stopped, straight):
        folder.mkdir()
    cell = f"FOLDER = {str(stopped)!r}\n{TRAIN}"

    printed, figures, error = run_cell(kernel, cell, interrupt_after=2)
    assert (
        error is None
        and "stopped: nothing that was logged is lost" in printed
        and "complete: False" in printed
    )
    printed, again, error = run_cell(kernel, cell)
    assert error is None and "complete: True" in printed
    # It shows at once what was there: what was seen last, or a step more, if the stop came between file and figure.
    assert again[0] == figures[-1] or step_of(again[0]) == step_of(figures[-1]) + 1
    printed, last, error = run_cell(kernel, cell)
    assert error is None and last == again[-1:]  # a finished training is shown, not repeated

    train_autoencoder("frame", settings, tmp_path / "rollouts", straight)
    weights = [load_file(folder / "autoencoder.safetensors") for folder in (stopped, straight)]
    assert all(weights[0][name].equal(weights[1][name]) for name in weights[1])
