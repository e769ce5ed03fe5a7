"""The measures of V and M, against answers that are known by construction."""

import math

import numpy as np
import pytest
import torch

from stad_lab.config import Settings
from stad_lab.envs.frames import earlier_frames
from stad_lab.evaluation.metrics import (
    autoencoder_quality,
    constant_forecast,
    dream_with,
    forecast,
    gaussian_nll,
    horizon_errors,
    linear_forecast,
    mixture_nll,
    pit,
    redraw,
    region_masks,
    repeat_forecast,
    single_step_nll,
)
from stad_lab.evaluation.trajectories import record_random_drive
from stad_lab.models.mdn_rnn import MDNRNN, Mixture, mdn_loss, sample_mixture
from stad_lab.models.vae import AutoEncoder, to_pictures


@pytest.fixture(scope="module")
def film():
    """Frames of one drive."""
    return record_random_drive(Settings.preset("quick", seed=3, random_starts=1.0), 0).frames(True)


def latents_and_actions(drives=30, length=20, size=4, seed=0):
    """Some z and actions."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((drives, length, size), np.float32), rng.random(
        (drives, length, 3), np.float32
    )


def make_mdn_rnn(seed=0):
    torch.manual_seed(seed)
    return MDNRNN(4, 8, 3)


def test_the_regions_part_the_picture_and_find_road_grass_and_car(film):
    masks = region_masks(film)
    assert (sum(mask.astype(int) for mask in masks.values()) == 1).all()
    red = (film[..., 0].astype(int) > film[..., 1].astype(int) + 60) & (film[..., 2] < 60)
    on_car = red[:, *np.nonzero(masks["car"][0])]
    assert on_car.any(axis=1).all()  # there is always something red under the car's mask
    spread = film.max(axis=-1).astype(int) - film.min(axis=-1)
    assert spread[masks["road"]].mean() < 20 < 80 < spread[masks["grass"]].mean()


def test_v_s_quality_is_that_of_its_loss(film):
    torch.manual_seed(0)
    autoencoder, earlier = AutoEncoder("input_output", width=4), earlier_frames(film, 4)
    found = autoencoder_quality(autoencoder, film, earlier)
    frame, difference = to_pictures(film, earlier)
    with torch.no_grad():
        drawn, changed = autoencoder.reconstruct(frame, difference)
    assert found["frame_error"] == pytest.approx(
        ((drawn - frame) ** 2).sum().item() / len(film), rel=1e-4
    )
    assert found["difference_error"] == pytest.approx(
        ((changed - difference) ** 2).sum().item() / len(film), rel=1e-4
    )
    assert found["blank_difference_error"] == pytest.approx(
        (difference**2).sum().item() / len(film), rel=1e-4
    )
    total = sum(region["share"] * region["error"] for region in found["regions"].values()) * 64 * 64
    assert total == pytest.approx(found["frame_error"], rel=1e-4)
    assert sum(found["kl_of_latents"]) == pytest.approx(found["kl"], rel=1e-4)
    assert redraw(autoencoder, film, earlier).frames.shape == film.shape


def test_a_latent_that_tells_nothing_is_not_active(film):
    autoencoder = AutoEncoder("frame", width=4)
    with torch.no_grad():
        for parameter in autoencoder.encoder[-1].parameters():
            parameter.zero_()  # mu = 0 and logvar = 0: the prior
        autoencoder.encoder[-1].bias[5] = 2.0
    found = autoencoder_quality(autoencoder, film, film)
    assert (
        found["active"] == 1
        and found["kl"] == pytest.approx(2.0)
        and found["difference_error"] is None
    )


def test_the_gaussian_nll_is_that_of_torch_distributions():
    error, sigma = np.array([0.3, -2.0]), np.array([0.5, 1.5])
    expected = (
        -torch.distributions.Normal(0.0, torch.tensor(sigma)).log_prob(torch.tensor(error)).numpy()
    )
    assert np.allclose(gaussian_nll(error, sigma), expected)


def test_a_random_walk_is_best_repeated_and_a_linear_law_is_found():
    steps, actions = latents_and_actions(drives=200)
    walk = 0.1 * steps.cumsum(axis=1)
    entropy = 0.5 * math.log(2 * math.pi * math.e * 0.01)  # of a step: no forecast can do better
    assert constant_forecast(steps[:100], steps[100:]).mean() == pytest.approx(
        entropy + math.log(10), abs=0.03
    )
    assert repeat_forecast(walk[:100], walk[100:]).mean() == pytest.approx(entropy, abs=0.03)
    assert linear_forecast(
        walk[:100], actions[:100], walk[100:], actions[100:], 1
    ).mean() == pytest.approx(entropy, abs=0.03)
    driven = walk.copy()
    driven[:, 1:, 0] = 0.9 * walk[:, :-1, 1] + actions[:, :-1, 2] + 0.01 * steps[:, 1:, 2]
    nll = linear_forecast(driven[:100], actions[:100], driven[100:], actions[100:], 1)
    assert nll[..., 0].mean() == pytest.approx(
        0.5 * math.log(2 * math.pi * math.e * 0.0001), abs=0.05
    )
    assert linear_forecast(walk[:100], actions[:100], walk[100:], actions[100:], 4).shape == (
        100,
        16,
        4,
    )


def test_m_s_nll_is_its_loss_and_frame_by_frame():
    mdn_rnn, (z, actions) = make_mdn_rnn(), latents_and_actions()
    mixture = forecast(mdn_rnn, z, actions)
    nll = mixture_nll(mixture, z)
    assert nll.shape == (30, 19, 4)
    assert nll.mean() == pytest.approx(
        mdn_loss(mixture, torch.from_numpy(z[:, 1:])).item(), rel=1e-5
    )


def test_a_single_step_is_judged_as_a_drive_of_two_frames():
    mdn_rnn, (z, actions) = make_mdn_rnn(), latents_and_actions(drives=3, length=6)
    found = single_step_nll(mdn_rnn, z, actions)
    assert found.shape == (3, 5, 4)
    for t in range(5):
        pair, done = z[:, t : t + 2], actions[:, t : t + 2]
        assert np.allclose(
            found[:, t], mixture_nll(forecast(mdn_rnn, pair, done), pair)[:, 0], atol=1e-5
        )


@pytest.mark.parametrize(("spread", "shape"), [(1.0, "uniform"), (2.0, "edges"), (0.5, "middle")])
def test_pit_is_uniform_for_an_honest_forecast_and_tells_too_sure_from_not_sure_enough(
    spread, shape
):
    generator = torch.Generator().manual_seed(0)
    logits, mean, logsigma = torch.randn(3, 50, 40, 4, 3, generator=generator)
    mixture = Mixture(logits.log_softmax(-1), 0 * mean, 0.1 * logsigma)
    z = spread * sample_mixture(mixture, 1.0, generator)
    z = torch.cat([z[:, :1], z], dim=1).numpy()
    found = pit(mixture, z)
    assert found.min() >= 0 and found.max() <= 1
    edges = (np.abs(found - 0.5) > 0.4).mean()
    bounds = {"uniform": (0.18, 0.22), "edges": (0.3, 1), "middle": (0, 0.1)}[shape]
    assert bounds[0] < edges < bounds[1]


def test_dreams_begin_where_the_car_fell_asleep_and_repeat_for_a_seed():
    mdn_rnn, (z, actions) = make_mdn_rnn(), latents_and_actions(drives=5)
    dreamed = dream_with(mdn_rnn, z, actions, awake=8, dreams=6)
    assert dreamed.shape == (6, 5, 12, 4)
    assert np.array_equal(dreamed, dream_with(mdn_rnn, z, actions, awake=8, dreams=6))
    changed = z.copy()
    changed[:, 8:] = 0  # M must not see what comes after it fell asleep
    assert np.array_equal(dreamed, dream_with(mdn_rnn, changed, actions, awake=8, dreams=6))
    expected = mdn_rnn(torch.from_numpy(z[:, :8]), torch.from_numpy(actions[:, :8]))[0]
    mean = (expected.logpi.exp() * expected.mean).sum(-1)[:, -1].detach().numpy()
    many = dream_with(mdn_rnn, z, actions, awake=8, dreams=2000)[:, :, 0].mean(axis=0)
    assert np.abs(many - mean).max() < 0.15


def test_horizon_errors_are_zero_for_the_truth_and_grow_with_what_is_dreamed_wrong():
    torch.manual_seed(0)
    autoencoder, (mu, _) = (
        AutoEncoder("frame", latent_size=4, width=4),
        latents_and_actions(drives=40),
    )
    real = np.repeat(mu[None, :, 8:], 3, axis=0)
    errors = horizon_errors(autoencoder, real, mu, awake=8, steps=[1, 5, 12])
    assert np.allclose(errors["one dream"], 0, atol=1e-3) and np.allclose(
        errors["mean of the dreams"], 0, atol=1e-3
    )
    assert np.allclose(
        errors["the last frame seen"], np.sqrt(2), atol=0.25
    )  # two independent draws
    wrong = (
        real
        + 0.5
        * np.arange(12, dtype=np.float32)[:, None]
        * np.array([1, -1, 1], np.float32)[:, None, None, None]
    )
    errors = horizon_errors(autoencoder, wrong, mu, awake=8, steps=[1, 5, 12])
    assert errors["one dream"][0] < 1e-3 < errors["one dream"][1] < errors["one dream"][2]
    assert errors["mean of the dreams"][2] < errors["one dream"][2]
