"""The compiled V and M: the networks' own numbers, for every size, and for every batch."""

import numpy as np
import pytest
import torch

from stad_lab.envs.frames import to_pictures
from stad_lab.inference import Inference
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE, VARIANTS, to_tensor


def make_inputs(cars, latent_size, hidden_size):
    """Frames, earlier frames, actions and a memory."""
    rng = np.random.default_rng(cars)
    frames, earlier = rng.integers(0, 256, (2, cars, 64, 64, 3), np.uint8)
    actions = rng.uniform(-1, 1, (cars, 3)).astype(np.float32)
    return frames, earlier, actions, rng.standard_normal((2, cars, hidden_size), np.float32)


@pytest.mark.parametrize(
    ("variant", "latent_size", "width", "hidden_size", "cars"),
    [
        ("frame", 32, 16, 256, 7),
        ("input", 32, 32, 256, 1),
        ("output", 5, 3, 24, 16),
        ("input_output", 70, 17, 9, 2),
    ],
)
@torch.no_grad()
def test_v_and_m_give_what_the_networks_give(variant, latent_size, width, hidden_size, cars):
    torch.manual_seed(0)
    vae, mdn_rnn = VAE(variant, latent_size, width), MDNRNN(latent_size, hidden_size, 2)
    frames, earlier, actions, state = make_inputs(cars, latent_size, hidden_size)
    inference = Inference(vae, mdn_rnn)
    latents = inference.encode(frames, earlier)
    expected = vae.encode(*map(to_tensor, to_pictures(frames, earlier)))[0].numpy()
    assert latents.dtype == np.float32 and latents.shape == (cars, latent_size)
    assert np.abs(latents - expected).max() < 1e-5
    before = state.copy()
    after = inference.remember(latents, actions, state)
    seen = (torch.from_numpy(part)[:, None] for part in (latents, actions))
    _, expected = mdn_rnn.remember(*seen, tuple(torch.from_numpy(part)[None] for part in state))
    assert np.abs(after - torch.cat(expected).numpy()).max() < 1e-5
    assert np.array_equal(state, before)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_car_s_numbers_are_bit_identical_in_every_batch(variant):
    inference = Inference(VAE(variant, 32, 16), MDNRNN(32, 256, 5))
    frames, earlier, actions, state = make_inputs(13, 32, 256)
    latents = inference.encode(frames, earlier)
    after = inference.remember(latents, actions, state)
    for cars in ([12], [3, 4], list(range(2, 10))):
        own = inference.encode(frames[cars], earlier[cars])
        assert np.array_equal(own, latents[cars])
        memory = inference.remember(own, actions[cars], state[:, cars])
        assert np.array_equal(memory, after[:, cars])


def test_what_is_not_a_number_stays_so():
    vae, mdn_rnn = VAE("frame", 8, 4), MDNRNN(8, 16, 2)
    vae.encoder[0].bias.data[0] = float("nan")
    frames, earlier, *_ = make_inputs(1, 8, 16)
    assert np.isnan(Inference(vae, mdn_rnn).encode(frames, earlier)).all()


def test_an_inference_does_not_follow_a_training():
    vae, mdn_rnn = VAE("frame", 8, 4), MDNRNN(8, 16, 2)
    frames, earlier, *_ = make_inputs(1, 8, 16)
    inference = Inference(vae, mdn_rnn)
    before = inference.encode(frames, earlier)
    for parameter in vae.parameters():
        parameter.data.zero_()
    assert np.array_equal(inference.encode(frames, earlier), before)
