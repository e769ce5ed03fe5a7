"""Training in a real kernel: a cell that was stopped continues, bit for bit."""

import os
import re
import shutil

import pytest
from jupyter_client.manager import start_new_kernel
from safetensors.torch import load_file

from stad_lab import Config
from stad_lab.training.dataset import Dataset
from stad_lab.training.vae import train_vae

CONFIG = Config.preset("quick", variant="frame", vae={"steps": 8})
TRAIN = """
from pathlib import Path
from stad_lab import Config
from stad_lab.training.dataset import Dataset
from stad_lab.training.vae import train_vae
from stad_lab.viz.plots import plot_history
from stad_lab.viz.widgets import watch_training
config = Config.preset("quick", variant="frame", vae={"steps": 8})
plot = lambda history: plot_history(history, f"step {history[-1]['step']}", "loss")
folder = Path(FOLDER)
dataset = lambda: Dataset(folder.parent / "dataset")
train = lambda watch: train_vae(config, dataset, folder, watch)
print("complete:", watch_training(train, plot))
"""


@pytest.fixture(scope="module")
def kernel():
    """A kernel as JupyterLab starts it: (manager, client)."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    manager, client = start_new_kernel(kernel_name="python3", env=environment)
    yield manager, client
    client.stop_channels()
    manager.shutdown_kernel(now=True)


def run_cell(kernel, code, interrupt_after=None):
    """Run a cell, and press stop after so many figures: (what it printed, its figures, error)."""
    manager, client = kernel
    figures, printed = [], []

    def take(message):
        kind, content = message["msg_type"], message["content"]
        if kind in ("display_data", "update_display_data"):
            html = content["data"].get("text/html", "")
            if "<img" in html:
                figures.append(html)
                if len(figures) == interrupt_after:
                    manager.interrupt_kernel()
        if kind == "stream" and content["name"] == "stdout":
            printed.append(content["text"])

    reply = client.execute_interactive(code, output_hook=take, timeout=120)["content"]
    return "".join(printed), figures, None if reply["status"] == "ok" else reply["ename"]


def step_of(figure):
    """How many steps a figure shows, by its alternative text."""
    return int(re.search(r'alt="step (\d+)', figure)[1])


def test_a_training_that_was_stopped_in_its_cell_continues_to_the_same_bits(
    kernel, quick_run, tmp_path
):
    shutil.copytree(quick_run / "dataset", tmp_path / "dataset")
    stopped, uninterrupted = tmp_path / "stopped", tmp_path / "uninterrupted"
    cell = f"FOLDER = {str(stopped)!r}\n{TRAIN}"

    printed, figures, error = run_cell(kernel, cell, interrupt_after=2)
    assert error is None and "stopped: " in printed and "complete: False" in printed
    printed, again, error = run_cell(kernel, cell)
    assert error is None and "complete: True" in printed
    # It shows what was there, or a step more if the stop came between the file and the figure.
    assert again[0] == figures[-1] or step_of(again[0]) == step_of(figures[-1]) + 1
    printed, last, error = run_cell(kernel, cell)
    assert error is None and last == again[-1:]  # a finished training is shown, not repeated

    train_vae(CONFIG, lambda: Dataset(tmp_path / "dataset"), uninterrupted)
    first, second = (load_file(one / "vae.safetensors") for one in (stopped, uninterrupted))
    assert all(first[name].equal(second[name]) for name in second)
