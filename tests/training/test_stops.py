"""A training that is stopped again and again, by every signal, ends in the same bits."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from stad_lab.io.files import load_json
from stad_lab.io.weights import CONTROLLER_FILE, MDN_RNN_FILE, VAE_FILE
from stad_lab.training.evolution import LOG

SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGKILL")
    if hasattr(signal, name)
]
STOPS = 100
LONGEST = 8.0  # seconds until a stop; the whole training takes about twice as long
COMMAND = [sys.executable, "-m", "stad_lab", "train", "quick", "--variant", "input_output"]


def start(run):
    """The command that made the quick run, in a process group of its own."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*COMMAND, "--out", str(run)], start_new_session=True, **quiet)


def stop_once(run, seconds, sent):
    """Stop the command after so many seconds; False if it had finished before."""
    process = start(run)
    try:
        process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, sent)
        _, told = process.communicate(timeout=60)
        assert "Traceback" not in told or sent == signal.SIGQUIT, told
        return True
    assert process.returncode == 0
    return False


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="Windows knows no process groups of this kind")
def test_a_hundred_stops_at_random_moments_by_every_signal_change_no_bit(quick_run, tmp_path):
    rng, stopped, runs = np.random.default_rng(0), 0, 0
    while stopped < STOPS:
        runs += 1
        run = tmp_path / f"run{runs}"
        while stop_once(run, rng.uniform(0.5, LONGEST), SIGNALS[stopped % len(SIGNALS)]):
            stopped += 1
        for name in (VAE_FILE, MDN_RNN_FILE, CONTROLLER_FILE):
            assert (run / name).read_bytes() == (quick_run / name).read_bytes(), name
        generations = [load_json(one / LOG)["generations"] for one in (run, quick_run)]
        assert generations[0] == generations[1]
        assert not [file for file in run.rglob("*") if file.suffix in (".tmp", ".part")]
