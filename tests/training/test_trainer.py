"""The training loop of V and M: its noise, learning rate, gradients, and what it leaves alone."""

import contextlib
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from stad_lab.config import Config, random_stream
from stad_lab.io.files import load_tensors
from stad_lab.models.mdn_rnn import LOGSIGMA_RANGE, MDNRNN, mdn_loss
from stad_lab.models.vae import LOGVAR_RANGE, VAE, vae_losses
from stad_lab.training import trainer
from stad_lab.training import vae as vae_training
from stad_lab.training.dataset import Dataset
from stad_lab.training.pipeline import train
from stad_lab.training.trainer import Training, fit, update
from stad_lab.training.vae import CHECKPOINT, train_vae

QUICK = Config.preset("quick")


def small_training(folder, model, **changes):
    """A training of a tiny model, whose loss is its output."""
    fields = {
        "model": model,
        "batch": lambda step: (torch.ones(1),),
        "losses": lambda x: {"total": model(x).sum()},
        "heldout_losses": lambda: {"total": 0.0},
        "steps": 100,
        "learning_rate": 0.5,
        "checkpoint": folder / "state",
        "made_with": {},
        "label": "fit",
    }
    return Training(**fields | changes)


def test_the_learning_rate_falls_to_a_tenth_along_a_cosine(tmp_path, monkeypatch):
    rates = []
    monkeypatch.setattr(trainer, "update", lambda *given: rates.append(given[3]))
    fit(small_training(tmp_path, torch.nn.Linear(1, 1)))
    assert len(rates) == 100 and rates[0] == 0.5 and rates[50] == pytest.approx(0.275)
    assert rates[-1] == pytest.approx(0.05, rel=0.01) and rates == sorted(rates, reverse=True)


def test_weights_that_are_not_finite_after_the_last_step_are_not_saved(tmp_path):
    model = torch.nn.Linear(1, 1)
    training = small_training(tmp_path, model, steps=1)
    training.losses = lambda x: {"total": torch.sqrt(0 * model(x)).sum()}
    training.heldout_losses = lambda: {"total": model(torch.ones(1)).item()}
    with pytest.raises(FloatingPointError, match="fit: the loss is nan in step 0"):
        fit(training)
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize(("slope", "moved"), [(3.0, 3.0), (1e6, 100.0)])
def test_a_gradient_is_shortened_to_a_norm_of_100(slope, moved):
    model = torch.nn.Linear(1, 1, bias=False)
    before = model.weight.item()
    optimizer = torch.optim.SGD(model.parameters(), lr=9.0)
    update(model, optimizer, slope * model.weight.sum(), rate=0.1)
    assert before - model.weight.item() == pytest.approx(0.1 * moved, rel=1e-4)


@pytest.fixture
def dataset(quick_run):
    """A function that opens the dataset of the quick run, as the stages are given it."""
    opened = Dataset(quick_run / "dataset")
    return lambda: opened


def test_v_is_trained_on_other_noise_in_every_step_and_on_the_same_in_every_run(
    dataset, tmp_path, monkeypatch
):
    sampled = []

    def watched(*given, **weights):
        sampled.append(given[3])
        return vae_losses(*given, **weights)

    monkeypatch.setattr(vae_training, "vae_losses", watched)
    config = QUICK.replace(variant="input", vae={"steps": 2})
    for folder in ("one", "again"):
        assert train_vae(config, dataset, tmp_path / folder)
    half = len(sampled) // 2
    first, second = (noise for noise in sampled[:half] if len(noise) == config.vae.batch)
    assert abs(np.std([first.numpy(), second.numpy()]) - 1) < 0.1 and not torch.equal(first, second)
    assert all(map(torch.equal, sampled[:half], sampled[half:]))


@contextlib.contextmanager
def default_dtype(dtype):
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextlib.contextmanager
def unusual_torch():
    with default_dtype(torch.float64), torch.no_grad():
        yield


def test_a_training_leaves_torch_as_it_was_and_gives_the_same_v_and_m(quick_run, tmp_path):
    torch.manual_seed(123)
    shutil.copytree(quick_run / "dataset", tmp_path / "dataset")
    with unusual_torch():
        before = torch.get_rng_state(), torch.get_default_dtype(), torch.is_grad_enabled()
        train(QUICK, tmp_path, until="mdn_rnn")
        after = torch.get_rng_state(), torch.get_default_dtype(), torch.is_grad_enabled()
    assert torch.equal(before[0], after[0]) and before[1:] == after[1:]
    for name in ("vae.safetensors", "mdn_rnn.safetensors"):
        assert (tmp_path / name).read_bytes() == (quick_run / name).read_bytes()


def test_an_interrupted_training_leaves_torch_as_it_was(dataset, tmp_path, interrupt_after):
    state = torch.get_rng_state()
    with unusual_torch():
        with interrupt_after(3):
            train_vae(QUICK, dataset, tmp_path)
        assert torch.get_default_dtype() == torch.float64 and not torch.is_grad_enabled()
    assert torch.equal(torch.get_rng_state(), state)


def test_a_half_trained_v_continues_with_another_sigma_and_with_no_other_setting_of_v(
    dataset, quick_run, tmp_path, interrupt_after
):
    with interrupt_after(10):
        train_vae(QUICK, dataset, tmp_path)
    checkpoint = (tmp_path / CHECKPOINT).read_bytes()
    other = QUICK.replace(vae={"kl_weight": 0.5})
    with pytest.raises(ValueError, match=r"vae\.kl_weight=0\.25, now vae\.kl_weight=0\.5 is asked"):
        train_vae(other, dataset, tmp_path)
    assert (tmp_path / CHECKPOINT).read_bytes() == checkpoint
    seen = []
    sigma = QUICK.replace(evolution={"sigma": 0.3}, mdn_rnn={"steps": 9}, processes=1)
    train_vae(sigma, dataset, tmp_path, lambda history: seen.append(history[-1]["step"]))
    assert seen[0] == 8  # it continued from its last checkpoint
    found, expected = (load_file(one / "vae.safetensors") for one in (tmp_path, quick_run))
    assert all(found[name].equal(expected[name]) for name in expected)


def test_a_command_with_another_setting_of_a_half_trained_m_leaves_the_record_as_it_is(
    quick_run, tmp_path, interrupt_after, monkeypatch
):
    kept = shutil.ignore_patterns("mdn_rnn*", "controller*", "components*", "evolution*")
    run = shutil.copytree(quick_run, tmp_path / "run", ignore=kept)
    with interrupt_after(10):
        train(QUICK, run)
    before = (run / "record.json").read_bytes()
    monkeypatch.setattr("stad_lab.training.record.HEARTBEAT", 0.001)  # any work is noted
    with pytest.raises(ValueError, match=r"mdn_rnn\.steps=\d+, now mdn_rnn\.steps=9 is asked for"):
        train(QUICK.replace(mdn_rnn={"steps": 9}), run)
    assert (run / "record.json").read_bytes() == before


def test_a_checkpoint_made_before_a_setting_existed_continues(dataset, tmp_path, interrupt_after):
    brief = QUICK.replace(vae={"steps": 12})
    with interrupt_after(10):
        train_vae(brief, dataset, tmp_path)
    tensors, metadata = load_tensors(tmp_path / CHECKPOINT)
    del metadata["made_with"]["vae"]["difference_weight"]
    trainer.save_tensors(tmp_path / CHECKPOINT, tensors, **metadata)
    older = shutil.copytree(tmp_path, tmp_path / "older")
    assert train_vae(brief, dataset, tmp_path)
    with pytest.raises(ValueError, match=r"made with vae.difference_weight=1.0, now vae.differ"):
        train_vae(brief.replace(vae={"difference_weight": 2.0}), dataset, older)


def test_values_beyond_the_bounds_of_logvar_and_logsigma_still_have_a_gradient():
    vae = VAE("frame", 4, 4)
    pictures = torch.rand(2, 3, 64, 64), torch.zeros(2, 3, 64, 64)
    bias = vae.encoder[-1].bias
    for value in (LOGVAR_RANGE[0] - 1, LOGVAR_RANGE[1] + 1):
        bias.data[4:] = value
        vae.zero_grad()
        vae_losses(vae, *pictures, torch.zeros(2, 4))["total"].backward()
        assert (bias.grad[4:] != 0).all()
    mdn_rnn = MDNRNN(4, 8, 2)
    bias = mdn_rnn.head.bias
    for value in (LOGSIGMA_RANGE[0] - 1, LOGSIGMA_RANGE[1] + 1):
        bias.data[16:] = value
        mdn_rnn.zero_grad()
        mixture, _ = mdn_rnn(torch.randn(1, 5, 4), torch.zeros(1, 5, 3))
        mdn_loss(mixture, torch.randn(1, 5, 4)).backward()
        assert (bias.grad[16:] != 0).all()


def test_random_streams_of_different_purposes_and_numbers_do_not_collide():
    keys = [("vae", 0), ("vae", 0, 0), ("vae", 0, 1), ("vae", 0, 1, 0), ("vae", 0, 0, 1)]
    keys += [("mdn_rnn", 0, 1), ("vae", 1), ("vae", 1, 0), ("tracks", 0, 0), ("tracks", 0, 0, 0)]
    first = [random_stream(*key).integers(2**63) for key in keys]
    assert len(set(first)) == len(keys)
    assert first == [random_stream(*key).integers(2**63) for key in keys]
