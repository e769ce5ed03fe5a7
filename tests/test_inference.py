"""The compiled V and M: the networks' own numbers, for every size, and for every batch."""

import numpy as np
import pytest
import torch
from torch import nn

from stad_lab.config import Config
from stad_lab.envs.frames import to_pictures
from stad_lab.inference import Inference
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import DIFFERENCE, VAE, to_tensor
from stad_lab.training.pipeline import train


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


@pytest.mark.parametrize("variant", DIFFERENCE)
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


class NewPictures(VAE):
    """A V that sees the difference image twice as bright."""

    def encode(self, frame, difference):
        """As if the difference were twice as bright."""
        return super().encode(frame, 2 * difference)


def with_layer(number, layer):
    """A V with another layer in its encoder."""
    vae = VAE("input", 8, 4)
    vae.encoder[number] = layer
    return vae


def with_lstm(**options):
    """An M with another LSTM."""
    mdn_rnn = MDNRNN(8, 16, 2)
    mdn_rnn.lstm = nn.LSTM(8 + 3, 16, batch_first=True, **options)
    return mdn_rnn


@pytest.mark.parametrize("kernel", [3, 5, 6])
@torch.no_grad()
def test_other_kernels_and_strides_are_read_from_the_network(kernel):
    torch.manual_seed(0)
    vae = with_layer(0, nn.Conv2d(6, 4, kernel, stride=3))
    vae.encoder[2] = nn.Conv2d(4, 8, 3, stride=1)
    size = vae.encoder[:9](torch.zeros(1, 6, 64, 64)).shape[1]
    vae.encoder[9] = nn.Linear(size, 16)
    frames, earlier, *_ = make_inputs(2, 8, 16)
    latents = Inference(vae, MDNRNN(8, 16, 2)).encode(frames, earlier)
    expected = vae.encode(*map(to_tensor, to_pictures(frames, earlier)))[0].numpy()
    assert np.abs(latents - expected).max() < 1e-5


@pytest.mark.parametrize(
    ("vae", "mdn_rnn", "message"),
    [
        (NewPictures("input", 8, 4), None, "V has numbers that the compiled ones do not equal"),
        (with_layer(1, nn.ELU()), None, "V has an encoder of Conv2d, ELU"),
        (with_layer(0, nn.Conv2d(6, 4, 4, 2, 1)), None, r"V has Conv2d.*padding=\(1, 1\)"),
        (with_layer(0, nn.Conv2d(6, 4, (4, 2), 2)), None, r"V has Conv2d.*kernel_size=\(4, 2\)"),
        (with_layer(0, nn.Conv2d(6, 4, 4, 2, bias=False)), None, "V has Conv2d.*bias=False"),
        (with_layer(0, nn.Conv2d(9, 4, 4, 2)), None, "V has 9 input channels"),
        (None, with_lstm(num_layers=2), "M has LSTM.*num_layers=2"),
        (None, with_lstm(bidirectional=True), "M has LSTM.*bidirectional=True"),
    ],
)
def test_a_network_that_is_not_compiled_is_refused_in_one_line(vae, mdn_rnn, message):
    with pytest.raises(ValueError, match=f"{message}.*inference.py") as caught:
        Inference(vae or VAE("input", 8, 4), mdn_rnn or MDNRNN(8, 16, 2))
    assert "\n" not in str(caught.value)


def test_a_run_whose_v_could_not_drive_is_refused_before_it_begins(tmp_path, monkeypatch):
    own = VAE.encode
    monkeypatch.setattr(VAE, "encode", lambda vae, frame, other: own(vae, frame, 2 * other))
    with pytest.raises(ValueError, match="V has numbers"):
        train(Config.preset("quick"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
