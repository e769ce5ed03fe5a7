"""The measures of V and M, against answers that are known by construction."""

import math

import numpy as np
import pytest
import torch

from stad_lab.config import Config
from stad_lab.envs.frames import earlier_frames, to_pictures
from stad_lab.evaluation.metrics import (
    clearest_case,
    constant_prediction,
    dream_open_loop,
    gaussian_nll,
    horizon_errors,
    linear_prediction,
    mixture_nll,
    pit,
    predict,
    reconstruct,
    region_masks,
    repeat_prediction,
    road_ahead,
    single_step_nll,
    two_peaks,
    vae_metrics,
)
from stad_lab.evaluation.trajectories import record_random_trajectory
from stad_lab.models.mdn_rnn import MDNRNN, Mixture, mdn_loss
from stad_lab.models.vae import VAE, to_tensor


@pytest.fixture(scope="module")
def frames():
    """Frames of one episode."""
    config = Config.preset("quick", seed=3, data={"random_starts": 1.0})
    return record_random_trajectory(config, 0).frames(True)


def latents_and_actions(episodes=30, length=20, size=4):
    """z and actions of some episodes."""
    rng = np.random.default_rng(0)
    latents = rng.standard_normal((episodes, length, size), np.float32)
    return latents, rng.random((episodes, length, 3), np.float32)


def make_mdn_rnn():
    """A small M with fixed random weights."""
    torch.manual_seed(0)
    return MDNRNN(4, 8, 3)


def test_the_regions_divide_the_picture_and_find_road_grass_and_car(frames):
    masks = region_masks(frames)
    assert (sum(mask.astype(int) for mask in masks.values()) == 1).all()
    red = (frames[..., 0].astype(int) > frames[..., 1].astype(int) + 60) & (frames[..., 2] < 60)
    on_car = red[:, *np.nonzero(masks["car"][0])]
    assert on_car.any(axis=1).all()  # there is always something red under the car's mask
    spread = frames.max(axis=-1).astype(int) - frames.min(axis=-1)
    assert spread[masks["road"]].mean() < 20 < 80 < spread[masks["grass"]].mean()


def test_the_metrics_of_v_are_those_of_its_loss(frames):
    torch.manual_seed(0)
    vae, earlier = VAE("input_output", width=4), earlier_frames(frames, 4)
    found = vae_metrics(vae, frames, earlier)
    frame, difference = map(to_tensor, to_pictures(frames, earlier))
    with torch.no_grad():
        frame_hat, difference_hat = vae.reconstruct(frame, difference)
    expected = {
        "frame_error": frame_hat - frame,
        "difference_error": difference_hat - difference,
        "blank_difference_error": difference,
    }
    for name, error in expected.items():
        assert found[name] == pytest.approx((error**2).sum().item() / len(frames), rel=1e-4)
    total = sum(region["share"] * region["error"] for region in found["regions"].values()) * 64 * 64
    assert total == pytest.approx(found["frame_error"], rel=1e-4)
    assert sum(found["kl_of_latents"]) == pytest.approx(found["kl"], rel=1e-4)
    assert reconstruct(vae, frames, earlier).frames.shape == frames.shape


def test_a_latent_that_carries_nothing_is_not_active(frames):
    vae = VAE("frame", width=4)
    with torch.no_grad():
        for parameter in vae.encoder[-1].parameters():
            parameter.zero_()  # mu = 0 and logvar = 0: the prior
        vae.encoder[-1].bias[5] = 2.0
    found = vae_metrics(vae, frames, frames)
    assert found["active"] == 1
    assert found["kl"] == pytest.approx(2.0)
    assert found["difference_error"] is None


def test_the_gaussian_nll_is_that_of_torch_distributions():
    error, sigma = np.array([0.3, -2.0]), np.array([0.5, 1.5])
    expected = -torch.distributions.Normal(0.0, torch.tensor(sigma)).log_prob(torch.tensor(error))
    assert np.allclose(gaussian_nll(error, sigma), expected)


def test_a_random_walk_is_best_repeated_and_a_linear_law_is_found():
    steps, actions = latents_and_actions(episodes=200)
    walk = 0.1 * steps.cumsum(axis=1)
    # Of a step of the walk: no prediction can do better.
    entropy = 0.5 * math.log(2 * math.pi * math.e * 0.01)
    constant = constant_prediction(steps[:100], steps[100:]).mean()
    assert constant == pytest.approx(entropy + math.log(10), abs=0.03)
    repeat = repeat_prediction(walk[:100], walk[100:]).mean()
    assert repeat == pytest.approx(entropy, abs=0.03)
    linear = linear_prediction(walk[:100], actions[:100], walk[100:], actions[100:], 1)
    assert linear.mean() == pytest.approx(entropy, abs=0.03)
    driven = walk.copy()
    driven[:, 1:, 0] = 0.9 * walk[:, :-1, 1] + actions[:, :-1, 2] + 0.01 * steps[:, 1:, 2]
    nll = linear_prediction(driven[:100], actions[:100], driven[100:], actions[100:], 1)
    expected = 0.5 * math.log(2 * math.pi * math.e * 0.0001)
    assert nll[..., 0].mean() == pytest.approx(expected, abs=0.05)
    longer = linear_prediction(walk[:100], actions[:100], walk[100:], actions[100:], 4)
    assert longer.shape == (100, 16, 4)


def test_the_nll_of_m_is_its_loss_frame_by_frame():
    mdn_rnn, (z, actions) = make_mdn_rnn(), latents_and_actions()
    mixture = predict(mdn_rnn, z, actions)
    nll = mixture_nll(mixture, z)
    assert nll.shape == (30, 19, 4)
    loss = mdn_loss(mixture, torch.from_numpy(z[:, 1:])).item()
    assert nll.mean() == pytest.approx(loss, rel=1e-5)


def test_a_single_step_is_measured_as_an_episode_of_two_frames():
    mdn_rnn, (z, actions) = make_mdn_rnn(), latents_and_actions(episodes=3, length=6)
    found = single_step_nll(mdn_rnn, z, actions)
    assert found.shape == (3, 5, 4)
    for t in range(5):
        pair, done = z[:, t : t + 2], actions[:, t : t + 2]
        expected = mixture_nll(predict(mdn_rnn, pair, done), pair)[:, 0]
        assert np.allclose(found[:, t], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("spread", "low", "high"),
    [
        pytest.param(1.0, 0.18, 0.22, id="calibrated"),
        pytest.param(2.0, 0.3, 1, id="overconfident"),
        pytest.param(0.5, 0, 0.1, id="underconfident"),
    ],
)
def test_pit_is_uniform_for_a_calibrated_prediction_alone(spread, low, high):
    generator = torch.Generator().manual_seed(0)
    logits, mean, logsigma = torch.randn(3, 50, 40, 4, 3, generator=generator)
    mixture = Mixture(logits.log_softmax(-1), 0 * mean, 0.1 * logsigma)
    z = spread * mixture.sample(1.0, generator)
    found = pit(mixture, torch.cat([z[:, :1], z], dim=1).numpy())
    assert found.min() >= 0 and found.max() <= 1
    assert low < (np.abs(found - 0.5) > 0.4).mean() < high


def test_dreams_begin_with_the_last_frame_that_m_saw_and_repeat():
    mdn_rnn, (z, actions) = make_mdn_rnn(), latents_and_actions(episodes=5)

    def dream(latents, dreams=6):
        return dream_open_loop(mdn_rnn, latents, actions, awake=8, dreams=dreams)

    dreamed = dream(z)
    assert dreamed.shape == (6, 5, 12, 4)
    assert np.array_equal(dreamed, dream(z))
    changed = z.copy()
    changed[:, 8:] = 0  # M does not see what comes later
    assert np.array_equal(dreamed, dream(changed))
    expected = mdn_rnn(torch.from_numpy(z[:, :8]), torch.from_numpy(actions[:, :8]))[0]
    mean = (expected.logpi.exp() * expected.mean).sum(-1)[:, -1].detach().numpy()
    assert np.abs(dream(z, 2000)[:, :, 0].mean(axis=0) - mean).max() < 0.15


def test_horizon_errors_are_zero_for_the_truth_and_grow_with_what_is_dreamed_wrong():
    torch.manual_seed(0)
    vae, (mu, _) = VAE("frame", latent_size=4, width=4), latents_and_actions(episodes=40)
    real = np.repeat(mu[None, :, 8:], 3, axis=0)
    errors = horizon_errors(vae, real, mu, awake=8, steps=[1, 5, 12])
    assert np.allclose(errors["one dream"], 0, atol=1e-3)
    assert np.allclose(errors["mean of the dreams"], 0, atol=1e-3)
    # The last frame seen is independent of the true one.
    assert np.allclose(errors["the last frame seen"], np.sqrt(2), atol=0.25)
    growing = 0.5 * np.arange(12, dtype=np.float32)[:, None]
    signs = np.array([1, -1, 1], np.float32)[:, None, None, None]
    errors = horizon_errors(vae, real + growing * signs, mu, awake=8, steps=[1, 5, 12])
    assert errors["one dream"][0] < 1e-3 < errors["one dream"][1] < errors["one dream"][2]
    assert errors["mean of the dreams"][2] < errors["one dream"][2]


def test_two_peaks_are_found_with_the_valley_between_them_and_one_peak_is_not():
    even, narrow = np.log([0.5, 0.5]), np.log([0.1, 0.1])
    rise, left, right = two_peaks(even, np.array([-1.0, 2.0]), narrow)
    assert rise > 0.95 and abs(left + 1) < 0.05 and abs(right - 2) < 0.05
    one = two_peaks(even, np.array([-0.05, 0.05]), narrow)
    both = two_peaks(*(np.stack([part] * 2) for part in (even, even, narrow)))
    assert not one.any() and both.shape == (2, 3) and not both.any()


def test_the_clearest_case_is_the_deepest_valley_of_which_a_peak_came_true():
    peaks = np.array([[0.9, -1.0, 1.0], [0.5, -1.0, 1.0], [0.0, 0.0, 0.0], [0.4, 0.0, 4.0]])
    assert clearest_case(peaks, np.array([0.1, 1.2, 0.0, 4.5])) == (1,)
    with pytest.raises(ValueError, match="got none of 4"):
        clearest_case(peaks, np.array([0.1, 0.0, 0.0, 2.0]))


def test_the_road_ahead_is_where_its_upper_half_lies():
    frames = np.zeros((3, 64, 64, 3), np.uint8)
    frames[..., 1] = 200  # grass
    frames[0, :, 40:50] = 100  # a road to the right
    frames[1, :32, 4:14] = 100  # one that leads to the left
    right, left, none = road_ahead(frames)
    assert right > 10 and left < -20 and none == 0
