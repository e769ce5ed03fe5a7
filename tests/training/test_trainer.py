"""The training loop of V and M: what its docstrings promise of noise, rate and gradients."""

import numpy as np
import pytest
import torch

from stad_lab.config import Settings
from stad_lab.models import vae as autoencoder
from stad_lab.training import trainer as training
from stad_lab.training.trainer import fit, update


def test_the_rate_falls_from_the_first_step_to_a_tenth_in_the_last(tmp_path, monkeypatch):
    rates, model = [], torch.nn.Linear(1, 1)
    monkeypatch.setattr(
        training, "update", lambda model, optimizer, total, rate: rates.append(rate)
    )
    losses = lambda x: {"total": model(x).sum()}
    fit(
        model,
        lambda step: (torch.ones(1),),
        losses,
        lambda: {"total": 0.0},
        100,
        0.5,
        tmp_path / "state",
        "fit",
        {},
    )
    assert len(rates) == 100 and rates[0] == 0.5 and rates[50] == pytest.approx(0.275)
    assert rates[-1] == pytest.approx(0.05, rel=0.01) and rates == sorted(rates, reverse=True)


def test_weights_that_the_last_step_has_spoilt_are_not_saved(tmp_path):
    model = torch.nn.Linear(1, 1)
    losses = lambda x: {"total": torch.sqrt(0 * model(x)).sum()}
    heldout = lambda: {"total": model(torch.ones(1)).item()}
    with pytest.raises(FloatingPointError, match="fit: the loss is nan in step 0"):
        fit(
            model,
            lambda step: (torch.ones(1),),
            losses,
            heldout,
            1,
            0.5,
            tmp_path / "state",
            "fit",
            {},
        )
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize(("slope", "moved"), [(3.0, 3.0), (1e6, 100.0)])
def test_a_gradient_is_shortened_to_a_norm_of_100(slope, moved):
    model = torch.nn.Linear(1, 1, bias=False)
    before = model.weight.item()
    update(model, torch.optim.SGD(model.parameters(), lr=9.0), slope * model.weight.sum(), rate=0.1)
    assert before - model.weight.item() == pytest.approx(0.1 * moved, rel=1e-4)


def test_v_is_trained_on_samples_of_z_that_differ_from_step_to_step_and_repeat(
    quick_run, tmp_path, monkeypatch
):
    drawn, own = [], autoencoder.autoencoder_losses
    monkeypatch.setattr(
        autoencoder, "autoencoder_losses", lambda *given: (drawn.append(given[3]), own(*given))[1]
    )
    settings = Settings.preset("quick", v_steps=2)
    for folder in ("one", "again"):
        (tmp_path / folder).mkdir()
        autoencoder.train_autoencoder("input", settings, quick_run / "rollouts", tmp_path / folder)
    first, second = (noise for noise in drawn[: len(drawn) // 2] if len(noise) == settings.v_batch)
    assert abs(np.std([first.numpy(), second.numpy()]) - 1) < 0.1 and not torch.equal(first, second)
    assert all(
        torch.equal(*pair)
        for pair in zip(drawn[: len(drawn) // 2], drawn[len(drawn) // 2 :], strict=True)
    )
