"""M: the mixture's likelihood, its samples, and one step against a sequence."""

import math

import pytest
import torch

from stad_lab.config import Config
from stad_lab.io.weights import load_mdn_rnn, save_mdn_rnn
from stad_lab.models.mdn_rnn import MDNRNN, Mixture, mdn_loss


def make_mdn_rnn(latent_size=4, hidden_size=8, mixtures=3):
    """A small M with fixed random weights."""
    torch.manual_seed(0)
    return MDNRNN(latent_size, hidden_size, mixtures)


def make_mixture(batch=2, time=5, latent_size=4, mixtures=3):
    """A mixture, far from symmetric."""
    generator = torch.Generator().manual_seed(1)
    logits, mean, logsigma = torch.randn(3, batch, time, latent_size, mixtures, generator=generator)
    return Mixture((2 * logits).log_softmax(-1), 2 * mean, logsigma)


def make_sequence(batch=2, time=6, latent_size=4):
    """Latents and actions."""
    generator = torch.Generator().manual_seed(2)
    latents = torch.randn(batch, time, latent_size, generator=generator)
    return latents, torch.rand(batch, time, 3, generator=generator)


def generator(seed=0):
    """A source of random numbers for samples."""
    return torch.Generator().manual_seed(seed)


def test_the_likelihood_is_that_of_torch_distributions():
    mixture, (target, _) = make_mixture(time=6), make_sequence()
    weights = torch.distributions.Categorical(logits=mixture.logpi)
    normals = torch.distributions.Normal(mixture.mean, mixture.logsigma.exp())
    expected = torch.distributions.MixtureSameFamily(weights, normals).log_prob(target)
    assert torch.allclose(mixture.log_likelihood(target), expected, rtol=1e-4)
    assert mdn_loss(mixture, target).item() == pytest.approx(-expected.mean().item(), rel=1e-5)


def test_the_loss_of_one_gaussian_is_the_closed_form():
    mean, sigma, target, shape = 0.3, 0.05, 0.36, (1, 1, 1, 1)
    parts = torch.zeros(shape), torch.full(shape, mean), torch.full(shape, math.log(sigma))
    expected = 0.5 * math.log(2 * math.pi) + math.log(sigma) + (target - mean) ** 2 / (2 * sigma**2)
    assert expected < 0  # a density may exceed 1
    found = mdn_loss(Mixture(*parts), torch.full((1, 1, 1), target))
    assert found.item() == pytest.approx(expected, rel=1e-4)


def test_targets_far_away_give_finite_losses_and_gradients():
    mdn_rnn = make_mdn_rnn()
    latents, actions = make_sequence()
    mixture, _ = mdn_rnn(latents, actions)
    loss = mdn_loss(mixture, torch.full_like(latents, 1e4))
    loss.backward()
    assert 1e4 < loss.item() < math.inf
    assert all(torch.isfinite(parameter.grad).all() for parameter in mdn_rnn.parameters())


def test_mixture_weights_sum_to_one_and_deviations_stay_in_bounds():
    mdn_rnn = make_mdn_rnn()
    mdn_rnn.head.weight.data *= 1000
    mixture, _ = mdn_rnn(*make_sequence())
    assert torch.allclose(mixture.logpi.exp().sum(-1), torch.ones(2, 6, 4))
    assert mixture.logsigma.min().item() == pytest.approx(-5)
    assert mixture.logsigma.max().item() == pytest.approx(3)


def test_predictions_and_losses_stay_on_one_device():
    mdn_rnn = make_mdn_rnn().to("meta")
    latents, actions = (part.to("meta") for part in make_sequence())
    mixture, state = mdn_rnn(latents, actions)
    mdn_loss(mixture, latents).backward()
    _, state = mdn_rnn.remember(latents[:, :1], actions[:, :1], state)
    assert mixture.sample().device.type == "meta"
    gradients = [parameter.grad for parameter in mdn_rnn.parameters()]
    assert {part.device.type for part in (*mixture, *state, *gradients)} == {"meta"}


def test_a_sequence_equals_repeated_single_steps():
    mdn_rnn = make_mdn_rnn()
    latents, actions = make_sequence()
    whole, last = mdn_rnn(latents, actions)
    state = remembered = None
    for t in range(latents.shape[1]):
        pair = latents[:, t : t + 1], actions[:, t : t + 1]
        step, state = mdn_rnn(*pair, state)
        _, remembered = mdn_rnn.remember(*pair, remembered)
        for part, expected in zip(step, whole, strict=True):
            assert torch.allclose(part[:, 0], expected[:, t], atol=1e-6)
    for final in (state, remembered):
        assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(final, last, strict=True))


@pytest.mark.parametrize("changed", [0, 1])
def test_a_prediction_depends_on_past_latents_and_actions_but_not_on_future_ones(changed):
    mdn_rnn, pair = make_mdn_rnn(), [part.clone() for part in make_sequence()]
    mean = mdn_rnn(*pair)[0].mean
    pair[changed][:, 3] += 1
    other = mdn_rnn(*pair)[0].mean
    assert torch.equal(mean[:, :3], other[:, :3])
    assert not torch.allclose(mean[:, 3], other[:, 3])
    assert not torch.allclose(mean[:, 5], other[:, 5])


def test_samples_at_temperature_one_have_the_mixture_s_mean_and_deviation():
    one = make_mixture(1, 1)
    many = Mixture(*(part.expand(50_000, 1, 4, 3) for part in one))
    samples = many.sample(1.0, generator())[:, 0]
    weights = one.logpi.exp()[0, 0]
    mean = (weights * one.mean[0, 0]).sum(-1)
    variance = (weights * (one.logsigma[0, 0].exp() ** 2 + one.mean[0, 0] ** 2)).sum(-1) - mean**2
    assert torch.allclose(samples.mean(0), mean, atol=0.05)
    assert torch.allclose(samples.std(0), variance.sqrt(), rtol=0.03)


def test_samples_at_a_low_temperature_shrink_to_the_likeliest_mean():
    one = make_mixture(1, 1)
    many = Mixture(*(part.expand(5_000, 1, 4, 3) for part in one))
    choice = one.logpi.argmax(-1, keepdim=True)
    likeliest, sigma = (
        part.gather(-1, choice)[0, 0, :, 0] for part in (one.mean, one.logsigma.exp())
    )
    cold = many.sample(0.01, generator())[:, 0]
    assert ((cold.mean(0) - likeliest).abs() < 0.01 * sigma).all()
    assert torch.allclose(cold.std(0), 0.1 * sigma, rtol=0.05)  # the root of the temperature


def test_at_a_high_temperature_unlikely_gaussians_are_sampled_more_often_and_all_are_wider():
    weights, shape = torch.tensor([0.8, 0.15, 0.05]), (1, 30_000, 1, 3)
    means = torch.tensor([-10.0, 0.0, 10.0])
    mixture = Mixture(weights.log().expand(shape), means.expand(shape), torch.zeros(shape))
    samples = mixture.sample(4.0, generator()).flatten()
    nearest = ((samples + 15) / 10).floor().clamp(0, 2)
    shares = torch.bincount(nearest.long()) / len(samples)
    assert torch.allclose(shares, weights**0.25 / (weights**0.25).sum(), atol=0.02)
    assert samples[nearest == 1].std() == pytest.approx(2.0, abs=0.1)


def test_samples_repeat_with_the_generator_and_leave_torch_s_own_alone():
    state = torch.get_rng_state()
    first, again, other = (make_mixture().sample(1.0, generator(seed)) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("temperature", [0, -1.0, float("nan"), float("inf")])
def test_a_temperature_that_is_no_positive_number_is_refused(temperature):
    message = f"temperature={temperature}: expected a finite number from 1e-6 on; 1 is as trained"
    with pytest.raises(ValueError, match=message):
        make_mixture().sample(temperature)


def test_saved_weights_are_loaded_to_the_same_predictions(tmp_path):
    mdn_rnn = make_mdn_rnn()
    config = Config.preset("quick", mdn_rnn={"hidden_size": 8, "mixtures": 3})
    save_mdn_rnn(tmp_path / "m.safetensors", mdn_rnn, config)
    loaded, metadata = load_mdn_rnn(tmp_path / "m.safetensors")
    assert torch.equal(loaded(*make_sequence())[0].mean, mdn_rnn(*make_sequence())[0].mean)
    assert metadata["latent_size"] == 4
    assert Config().replace(mdn_rnn=metadata["mdn_rnn"]).mdn_rnn == config.mdn_rnn


def test_weights_of_another_kind_are_refused(quick_run):
    with pytest.raises(ValueError, match="holds 'vae': expected a file of 'mdn_rnn'"):
        load_mdn_rnn(quick_run / "vae.safetensors")
