"""M: the mixture's likelihood, its samples, one step against a sequence, and a training that resumes."""

import math
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stad_lab.config import Settings
from stad_lab.io.files import load_json, load_tensors, save_json
from stad_lab.models import mdn_rnn as room
from stad_lab.models.mdn_rnn import (
    MDNRNN,
    Mixture,
    fit_mdn_rnn,
    load_mdn_rnn,
    mdn_loss,
    sample_mixture,
    save_mdn_rnn,
    sequence_batch,
    train_mdn_rnn,
)


def make_mdn_rnn(latent_size=4, hidden_size=8, mixtures=3):
    """A small M with fixed random weights."""
    torch.manual_seed(0)
    return MDNRNN(latent_size, hidden_size, mixtures)


def make_mixture(batch=2, time=5, latent_size=4, mixtures=3):
    """Some mixture, far from symmetric."""
    generator = torch.Generator().manual_seed(1)
    logits, mean, logsigma = torch.randn(3, batch, time, latent_size, mixtures, generator=generator)
    return Mixture((2 * logits).log_softmax(-1), 2 * mean, logsigma)


def make_sequence(batch=2, time=6, latent_size=4):
    """Latents and actions."""
    generator = torch.Generator().manual_seed(2)
    return torch.randn(batch, time, latent_size, generator=generator), torch.rand(
        batch, time, 3, generator=generator
    )


def test_the_loss_is_that_of_torch_distributions():
    mixture, (target, _) = make_mixture(time=6), make_sequence()
    weights = torch.distributions.Categorical(logits=mixture.logpi)
    normals = torch.distributions.Normal(mixture.mean, mixture.logsigma.exp())
    expected = -torch.distributions.MixtureSameFamily(weights, normals).log_prob(target).mean()
    assert mdn_loss(mixture, target).item() == pytest.approx(expected.item(), rel=1e-5)


def test_the_loss_of_one_gaussian_is_the_closed_form():
    mean, sigma, target = 0.3, 0.05, 0.36
    shape = (1, 1, 1, 1)
    mixture = Mixture(
        torch.zeros(shape), torch.full(shape, mean), torch.full(shape, math.log(sigma))
    )
    expected = 0.5 * math.log(2 * math.pi) + math.log(sigma) + (target - mean) ** 2 / (2 * sigma**2)
    assert expected < 0  # a density: the loss can honestly be negative
    assert mdn_loss(mixture, torch.full((1, 1, 1), target)).item() == pytest.approx(
        expected, rel=1e-4
    )


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
    assert mixture.logsigma.min() == -5
    assert mixture.logsigma.max() == 3


def test_predictions_and_losses_stay_on_one_device():
    mdn_rnn = make_mdn_rnn().to("meta")
    latents, actions = (part.to("meta") for part in make_sequence())
    mixture, state = mdn_rnn(latents, actions)
    mdn_loss(mixture, latents).backward()
    _, state = mdn_rnn.remember(latents[:, :1], actions[:, :1], state)
    assert {
        part.device.type for part in (*mixture, *state, *(p.grad for p in mdn_rnn.parameters()))
    } == {"meta"}


def test_a_sequence_equals_repeated_single_steps():
    mdn_rnn = make_mdn_rnn()
    latents, actions = make_sequence()
    whole, last = mdn_rnn(latents, actions)
    state = remembered = None
    for t in range(latents.shape[1]):
        step, state = mdn_rnn(latents[:, t : t + 1], actions[:, t : t + 1], state)
        _, remembered = mdn_rnn.remember(latents[:, t : t + 1], actions[:, t : t + 1], remembered)
        for part, name in zip(step, Mixture._fields, strict=True):
            assert torch.allclose(part[:, 0], getattr(whole, name)[:, t], atol=1e-6)
    for final in (state, remembered):
        assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(final, last, strict=True))


def test_a_prediction_depends_on_the_past_and_on_the_action_but_not_on_the_future():
    mdn_rnn = make_mdn_rnn()
    latents, actions = make_sequence()
    mean = mdn_rnn(latents, actions)[0].mean
    for change in (latents, actions):
        changed = change.clone()
        changed[:, 3] += 1
        pair = (changed, actions) if change is latents else (latents, changed)
        other = mdn_rnn(*pair)[0].mean
        assert torch.equal(mean[:, :3], other[:, :3])
        assert not torch.allclose(mean[:, 3], other[:, 3])
        assert not torch.allclose(mean[:, 5], other[:, 5])


def test_samples_at_temperature_one_have_the_mixture_s_mean_and_deviation():
    one = make_mixture(1, 1)
    many = Mixture(*(part.expand(50_000, 1, 4, 3) for part in one))
    samples = sample_mixture(many, 1.0, torch.Generator().manual_seed(0))[:, 0]
    weights = one.logpi.exp()[0, 0]
    mean = (weights * one.mean[0, 0]).sum(-1)
    variance = (weights * (one.logsigma[0, 0].exp() ** 2 + one.mean[0, 0] ** 2)).sum(-1) - mean**2
    assert torch.allclose(samples.mean(0), mean, atol=0.05)
    assert torch.allclose(samples.std(0), variance.sqrt(), rtol=0.03)


def test_samples_at_a_low_temperature_shrink_to_the_likeliest_mean():
    one = make_mixture(1, 1)
    many = Mixture(*(part.expand(5_000, 1, 4, 3) for part in one))
    likeliest = one.mean.gather(-1, one.logpi.argmax(-1, keepdim=True))[0, 0, :, 0]
    sigma = one.logsigma.gather(-1, one.logpi.argmax(-1, keepdim=True))[0, 0, :, 0].exp()
    cold = sample_mixture(many, 0.01, torch.Generator().manual_seed(0))[:, 0]
    assert ((cold.mean(0) - likeliest).abs() < 0.01 * sigma).all()
    assert torch.allclose(cold.std(0), 0.1 * sigma, rtol=0.05)  # the root of the temperature


def test_at_a_high_temperature_unlikely_gaussians_are_drawn_more_often_and_all_are_wider():
    weights = torch.tensor([0.8, 0.15, 0.05])
    shape = (1, 30_000, 1, 3)
    mixture = Mixture(
        weights.log().expand(shape),
        torch.tensor([-10.0, 0.0, 10.0]).expand(shape),
        torch.zeros(shape),
    )
    drawn = sample_mixture(mixture, 4.0, torch.Generator().manual_seed(0)).flatten()
    nearest = ((drawn + 15) / 10).floor().clamp(0, 2)
    shares = torch.bincount(nearest.long()) / len(drawn)
    assert torch.allclose(shares, weights**0.25 / (weights**0.25).sum(), atol=0.02)
    assert (drawn[nearest == 1]).std() == pytest.approx(2.0, abs=0.1)


def test_samples_repeat_with_the_generator_and_leave_torch_s_own_alone():
    state = torch.get_rng_state()
    draws = [
        sample_mixture(make_mixture(), 1.0, torch.Generator().manual_seed(seed))
        for seed in (3, 3, 4)
    ]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("temperature", [0, -1.0, float("nan"), float("inf")])
def test_a_temperature_that_is_no_positive_number_is_refused(temperature):
    with pytest.raises(
        ValueError,
        match=f"temperature={temperature}: expected a .*number above 0, from 1e-6 on; 1 is what M",
    ):
        sample_mixture(make_mixture(), temperature)


def test_sequences_are_stretches_of_one_episode_with_z_drawn_anew():
    lengths, latent_size = (9, 30, 12), 2
    encoded = [
        np.full((2, length, latent_size), -30.0, np.float32) for length in lengths
    ]  # hardly any noise
    actions = []
    for index, length in enumerate(lengths):
        encoded[index][0] = (100 * index + np.arange(length))[:, None]
        actions.append(
            np.repeat((100 * index + np.arange(length))[:, None], 3, 1).astype(np.float32)
        )
    latents, chosen = sequence_batch(encoded, actions, 10, 200, np.random.default_rng(0))
    assert latents.shape == (200, 11, 2)
    assert chosen.shape == (200, 10, 3)
    assert torch.equal(latents[:, :-1, 0].round(), chosen[:, :, 0])  # actions belong to their z
    assert ((latents[:, 1:] - latents[:, :-1]).round() == 1).all()  # in order, within one episode
    starts = set(latents[:, 0, 0].round().int().tolist())
    assert starts == {
        *range(100, 120),
        200,
        201,
    }  # every stretch that fits, none of the short episode
    encoded[1][1] = encoded[2][1] = 0  # deviation 1
    noisy = [
        sequence_batch(encoded, actions, 10, 50, np.random.default_rng(seed))[0]
        for seed in (0, 0, 1)
    ]
    assert torch.equal(noisy[0], noisy[1])
    assert not torch.equal(noisy[0], noisy[2])
    assert (
        noisy[0][:, :-1, 0]
        - sequence_batch(encoded, actions, 10, 50, np.random.default_rng(0))[1][..., 0]
    ).std() > 0.8


def test_sequences_longer_than_every_episode_are_refused():
    encoded = [np.zeros((2, 20, 2), np.float32)]
    with pytest.raises(
        ValueError,
        match="m_sequence=20, but the longest episode has 20 frames: use shorter sequences",
    ):
        sequence_batch(encoded, [np.zeros((20, 3), np.float32)], 20, 1, np.random.default_rng(0))


@pytest.mark.parametrize(("lengths", "which"), [((30, 10), "held-out"), ((10, 30), "training")])
def test_a_training_without_a_sequence_for_both_losses_is_refused_before_it_begins(
    lengths, which, tmp_path
):
    encoded, actions = (
        [np.zeros((2, n, 4), np.float32) for n in lengths],
        [np.zeros((n, 3), np.float32) for n in lengths],
    )
    episode = np.repeat([0, 1], lengths)
    rollouts = SimpleNamespace(
        episode=episode,
        identity="two",
        split=lambda: (np.flatnonzero(episode == 0), np.flatnonzero(episode == 1)),
    )
    settings = Settings.preset("quick", m_sequence=20)
    with pytest.raises(
        ValueError,
        match=f"m_sequence=20, but the longest {which} episode has 10 frames: use shorter",
    ):
        fit_mdn_rnn(
            tmp_path / "m", make_mdn_rnn(), "input", "v", encoded, actions, rollouts, settings
        )
    assert not list(tmp_path.iterdir())


def fit_made_up(path, heldout=0.0):
    """Train an M on made-up drives, in which the next z is the sign of the steering, and held-out ones that differ."""
    rng = np.random.default_rng(0)
    actions = [rng.choice([-1.0, 1.0], (40, 3)).astype(np.float32) for _ in range(12)]
    z = [
        np.concatenate([np.zeros((1, 4)), np.repeat(action[:-1, :1], 4, axis=1)])
        for action in actions
    ]
    encoded = [np.stack([one, np.full((40, 4), -8.0)]).astype(np.float32) for one in z]
    encoded[-1][0] += heldout
    episode = np.repeat(np.arange(12), 40)
    parts = np.flatnonzero(episode < 11), np.flatnonzero(episode == 11)
    rollouts = SimpleNamespace(episode=episode, identity=f"made up {heldout}", split=lambda: parts)
    settings = Settings.preset("quick", m_sequence=20, m_steps=60, m_learning_rate=2e-2)
    fit_mdn_rnn(
        path, make_mdn_rnn(hidden_size=16), "input", "v", encoded, actions, rollouts, settings
    )
    return *load_mdn_rnn(path), actions[-1], encoded[-1][0]


def test_m_learns_what_comes_next(tmp_path):
    mdn_rnn, _, actions, z = fit_made_up(tmp_path / "m.safetensors")
    mixture, _ = mdn_rnn(torch.from_numpy(z)[None], torch.from_numpy(actions)[None])
    expected = (mixture.logpi.exp() * mixture.mean).sum(-1)[0, :, 0]
    assert np.corrcoef(expected.detach(), actions[:, 0])[0, 1] > 0.9


def test_m_does_not_learn_from_held_out_episodes(tmp_path):
    (one, told, *_), (other, told_otherwise, *_) = (
        fit_made_up(tmp_path / f"{heldout}.safetensors", heldout) for heldout in (0.0, 5.0)
    )
    assert all(
        torch.equal(a, b)
        for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    )
    assert (
        told_otherwise["history"][-1]["heldout"]["total"]
        > told["history"][-1]["heldout"]["total"] + 1
    )


def test_training_lowers_the_held_out_loss(quick_run):
    history = load_mdn_rnn(quick_run / "mdn_rnn.safetensors")[1]["history"]
    assert [entry["step"] for entry in history] == list(range(1, 21))
    assert history[-1]["heldout"]["total"] < history[0]["heldout"]["total"]


def test_no_steps_leave_an_m_with_the_weights_that_it_began_with(quick_run, tmp_path, monkeypatch):
    settings = Settings.preset("quick", m_steps=0)
    shutil.copy(quick_run / "autoencoder.safetensors", tmp_path)
    monkeypatch.setattr(
        "stad_lab.models.mdn_rnn.encode_frames", None
    )  # for no step V need not look at an episode
    assert train_mdn_rnn("input_output", settings, quick_run / "rollouts", tmp_path)
    assert not train_mdn_rnn("input_output", settings, quick_run / "rollouts", tmp_path)
    untrained, facts = load_mdn_rnn(tmp_path / "mdn_rnn.safetensors", "input_output")
    torch.manual_seed(settings.seed)
    fresh = MDNRNN(settings.latent_size, settings.hidden_size, settings.mixtures)
    assert facts["history"] == []
    assert all(
        untrained.state_dict()[name].equal(weights) for name, weights in fresh.state_dict().items()
    )


def test_an_interrupted_training_equals_an_uninterrupted_one_bit_for_bit(
    quick_run, tmp_path, interrupt_after
):
    settings = Settings.preset("quick", m_steps=60)
    files = []
    for folder in (tmp_path / "one_go", tmp_path / "interrupted"):
        folder.mkdir()
        shutil.copy(quick_run / "autoencoder.safetensors", folder)
        files.append(folder / "mdn_rnn.safetensors")
        if folder.name == "interrupted":
            hook = interrupt_after(32)  # between two checkpoints, which come every third step
            with pytest.raises(KeyboardInterrupt):
                train_mdn_rnn("input_output", settings, quick_run / "rollouts", folder)
            hook.remove()
            assert not files[-1].exists()
        assert train_mdn_rnn("input_output", settings, quick_run / "rollouts", folder)
    (one_go, one_go_facts), (resumed, resumed_facts) = (load_tensors(file) for file in files)
    assert all(torch.equal(one_go[name], resumed[name]) for name in one_go | resumed)
    assert one_go_facts == resumed_facts
    assert files[0].read_bytes() == files[1].read_bytes()


def test_m_is_not_trained_on_other_rollouts_than_its_v(quick_run, tmp_path):
    rollouts = shutil.copytree(quick_run / "rollouts", tmp_path / "rollouts")
    manifest = load_json(rollouts / "manifest.json")
    save_json(rollouts / "manifest.json", manifest | {"blocks": manifest["blocks"][::-1]})
    shutil.copy(quick_run / "autoencoder.safetensors", tmp_path)
    with pytest.raises(ValueError, match="was trained on other rollouts than those in"):
        train_mdn_rnn("input_output", Settings.preset("quick"), rollouts, tmp_path)


def test_saved_weights_are_loaded_to_the_same_predictions(tmp_path):
    mdn_rnn = make_mdn_rnn()
    save_mdn_rnn(tmp_path / "m.safetensors", mdn_rnn, "input", Settings(), [])
    loaded, facts = load_mdn_rnn(tmp_path / "m.safetensors")
    assert torch.equal(loaded(*make_sequence())[0].mean, mdn_rnn(*make_sequence())[0].mean)
    assert (facts["latent_size"], facts["hidden_size"], facts["mixtures"]) == (4, 8, 3)


def test_weights_for_another_variant_are_refused(tmp_path):
    save_mdn_rnn(tmp_path / "m.safetensors", make_mdn_rnn(), "input", Settings(), [])
    with pytest.raises(
        ValueError, match="holds variant 'input', and 'frame' was asked for: give its own run"
    ):
        load_mdn_rnn(tmp_path / "m.safetensors", "frame")


def test_weights_of_another_part_are_refused(quick_run):
    with pytest.raises(ValueError, match="holds 'autoencoder': expected 'mdn_rnn'"):
        load_mdn_rnn(quick_run / "autoencoder.safetensors")


def test_every_step_of_m_sees_other_sequences(tmp_path, monkeypatch):
    drawn, own = [], room.sequence_batch
    monkeypatch.setattr(
        room, "sequence_batch", lambda *given: drawn.append(own(*given)) or drawn[-1]
    )
    fit_made_up(tmp_path / "m.safetensors")
    batches = [
        z for z, _ in drawn if len(z) == Settings.preset("quick").m_batch
    ]  # the held-out ones are larger
    assert len(batches) == len({z.numpy().tobytes() for z in batches}) == 60


def test_a_training_state_of_m_names_its_v_and_its_rollouts(tmp_path, monkeypatch):
    told, episode = [], np.repeat([0, 1], 30)
    monkeypatch.setattr(room, "fit", lambda *given: told.append(given[-1]) or [])
    parts = np.flatnonzero(episode == 0), np.flatnonzero(episode == 1)
    for v, seen in (("v", "one"), ("another", "one"), ("v", "other")):
        rollouts = SimpleNamespace(episode=episode, identity=seen, split=lambda: parts)
        settings = Settings.preset("quick", m_steps=0)
        fit_mdn_rnn(
            tmp_path / "m.safetensors", make_mdn_rnn(), "input", v, [], [], rollouts, settings
        )
    assert told[0] not in told[1:]
