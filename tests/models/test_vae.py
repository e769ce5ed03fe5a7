"""V: four variants, and the loss term by term."""

import typing

import numpy as np
import pytest
import torch
from torch import nn

from stad_lab.config import VARIANTS, Config
from stad_lab.envs.frames import to_pictures
from stad_lab.io.weights import load_vae, save_vae
from stad_lab.models import vae as models_vae
from stad_lab.models.vae import (
    VAE,
    ColourDeconvolution,
    PixelDeconvolution,
    soft_bound,
    to_array,
    to_tensor,
    to_uint8,
    vae_losses,
)


def make_vae(variant, width=4):
    """A small V with fixed random weights."""
    torch.manual_seed(0)
    return VAE(variant, latent_size=32, width=width)


def make_batch(count=3):
    """Frames, difference images and noise."""
    rng = np.random.default_rng(0)
    frames, earlier = rng.integers(0, 256, (2, count, 64, 64, 3), np.uint8)
    noise = torch.from_numpy(rng.standard_normal((count, 32), np.float32))
    return *map(to_tensor, to_pictures(frames, earlier)), noise


def test_a_configuration_offers_the_variants_that_v_has_those_of_the_paper_among_them():
    offered = typing.get_args(typing.get_type_hints(Config)["variant"])
    assert {*VARIANTS} <= {*offered} == {*models_vae.DIFFERENCE}


@pytest.mark.parametrize(
    ("variant", "seen", "decoded"),
    [("frame", 3, 3), ("input", 6, 3), ("output", 3, 6), ("input_output", 6, 6)],
)
def test_each_variant_sees_and_reconstructs_its_pictures(variant, seen, decoded):
    vae = make_vae(variant)
    frame, difference, _ = make_batch()
    mu, logvar = vae.encode(frame, difference)
    assert mu.shape == logvar.shape == (3, 32)
    ignores_difference = torch.equal(mu, vae.encode(frame, -difference)[0])
    assert ignores_difference == (seen == 3)
    frame_hat, difference_hat = vae.decode(mu)
    assert frame_hat.shape == frame.shape
    assert 0 <= frame_hat.min() <= frame_hat.max() <= 1
    if decoded == 3:
        assert difference_hat is None
    else:
        assert difference_hat.shape == difference.shape
        assert -1 <= difference_hat.min() < 0 < difference_hat.max() <= 1


def test_an_unknown_variant_is_refused_with_the_choices():
    message = "unknown variant 'both': choose one of frame, input, output, input_output"
    with pytest.raises(ValueError, match=message):
        VAE("both")


def test_the_layers_have_the_sizes_of_world_models():
    vae = VAE("frame")
    shapes = [tuple(layer.weight.shape) for layer in vae.encoder if hasattr(layer, "weight")]
    assert shapes == [(32, 3, 4, 4), (64, 32, 4, 4), (128, 64, 4, 4), (256, 128, 4, 4), (64, 1024)]
    shapes = [tuple(layer.weight.shape) for layer in vae.decoder if hasattr(layer, "weight")]
    assert shapes == [(1024, 32), (1024, 128, 5, 5), (128, 64, 5, 5), (64, 32, 6, 6), (32, 3, 6, 6)]


@pytest.mark.parametrize("variant", VARIANTS)
def test_pictures_weights_and_losses_stay_on_one_device(variant):
    # "meta" has no numbers, but refuses a mixture of devices as a GPU does.
    vae = make_vae(variant).to("meta", memory_format=torch.channels_last)
    losses = vae_losses(vae, *(part.to("meta") for part in make_batch()))
    losses["total"].backward()
    assert {loss.device.type for loss in losses.values()} == {"meta"}
    assert {parameter.grad.device.type for parameter in vae.parameters()} == {"meta"}


def test_a_decoded_difference_can_be_as_negative_as_it_can_be_positive():
    vae = make_vae("output")
    for bias in (-50.0, 50.0):
        vae.decoder[-1].bias.data.fill_(bias)
        frame, difference = (part.detach() for part in vae.decode(torch.zeros(1, 32)))
        assert frame.mean() == pytest.approx(0 if bias < 0 else 1)
        assert difference.mean() == pytest.approx(-1 if bias < 0 else 1)


def test_pictures_become_tensors_on_the_same_memory_and_back():
    pictures = np.random.default_rng(0).random((2, 64, 64, 3), np.float32)
    tensor = to_tensor(pictures)
    assert tensor.shape == (2, 3, 64, 64)
    assert np.shares_memory(to_array(tensor), pictures)
    assert np.array_equal(to_array(tensor), pictures)
    frames = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), np.uint8)
    assert np.array_equal(to_uint8(to_tensor(to_pictures(frames, frames)[0])), frames)


def test_kl_is_that_of_torch_distributions():
    vae = make_vae("input")
    vae.encoder[-1].weight.data *= 30  # far from N(0, 1)
    frame, difference, noise = make_batch()
    mu, logvar = vae.encode(frame, difference)
    posterior = torch.distributions.Normal(mu, torch.exp(logvar / 2))
    prior = torch.distributions.Normal(0.0, 1.0)
    expected = torch.distributions.kl_divergence(posterior, prior).sum(1).mean()
    kl = vae_losses(vae, frame, difference, noise)["kl"]
    assert kl > 1
    assert torch.allclose(kl, expected, rtol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("with_free_bits", [False, True])
def test_the_loss_is_the_plain_sum_of_its_named_terms(variant, with_free_bits):
    vae = make_vae(variant)
    vae.encoder[-1].weight.data *= 100  # some 60 nats of KL, so that each nat counts in the total
    vae.decoder[0].weight.data *= 30  # and z in the reconstruction
    frame, difference, noise = make_batch()
    mu, logvar = (part.detach().double().numpy() for part in vae.encode(frame, difference))
    z = torch.from_numpy(mu + np.sqrt(np.exp(logvar)) * noise.numpy()).float()
    decoded = [None if part is None else part.detach().numpy() for part in vae.decode(z)]
    kl = 0.5 * (mu**2 + np.exp(logvar) - 1 - logvar).sum(axis=1)
    # The median lies above the KL of some pictures and below that of others.
    free_bits = float(np.median(kl)) / 32 if with_free_bits else 0.0
    weights = {"kl_weight": 0.7, "difference_weight": 3.0, "free_bits": free_bits}
    losses = vae_losses(vae, frame, difference, noise, **weights)
    expected = {"kl": np.mean(kl), "frame_error": ((decoded[0] - frame.numpy()) ** 2).sum() / 3}
    total = expected["frame_error"] + 0.7 * np.maximum(kl, free_bits * 32).mean()
    if "output" in variant:
        expected["difference_error"] = ((decoded[1] - difference.numpy()) ** 2).sum() / 3
        total += 3.0 * expected["difference_error"]
    expected["total"] = total
    assert {name: loss.item() for name, loss in losses.items()} == pytest.approx(expected, rel=1e-5)


def gradient(**weights):
    """The gradient of the loss with respect to the encoder's last weights."""
    vae = make_vae("input")
    vae_losses(vae, *make_batch(), **weights)["total"].backward()
    return vae.encoder[-1].weight.grad


def test_below_the_free_bits_the_kl_has_no_gradient():
    without_kl = gradient(kl_weight=0.0)
    assert torch.equal(gradient(kl_weight=100.0, free_bits=5.0), without_kl)
    assert not torch.equal(gradient(kl_weight=100.0, free_bits=0.0), without_kl)


def test_the_noise_is_reparameterised():
    vae = make_vae("frame")
    frame, difference, noise = make_batch()
    silent = vae_losses(vae, frame, difference, torch.zeros_like(noise), kl_weight=0)["total"]
    reconstruction = vae.reconstruct(frame, difference)[0]
    assert torch.allclose(silent, ((reconstruction - frame) ** 2).sum() / 3)
    noisy = vae_losses(vae, frame, difference, noise, kl_weight=0)["total"]
    assert noisy != silent
    noisy.backward()
    assert all(rows.abs().max() > 0 for rows in vae.encoder[-1].weight.grad.chunk(2))


def test_a_soft_bound_keeps_to_its_range_and_has_a_gradient_outside():
    value = torch.tensor([-10.8, -10.4, 0.0, 10.4, 10.8], requires_grad=True)
    bounded = soft_bound(value, -10.0, 10.0)
    bounded.sum().backward()
    assert (bounded >= -10).all() and (bounded <= 10).all()
    assert bounded[2].item() == pytest.approx(0, abs=1e-6)
    assert (value.grad > 0.01).all()  # a clamp has 0 outside


def test_reconstruct_decodes_the_mean_and_repeats_itself():
    vae = make_vae("input_output")
    frame, difference, _ = make_batch()
    decoded = vae.decode(vae.encode(frame, difference)[0])
    for _ in range(2):
        assert all(map(torch.equal, vae.reconstruct(frame, difference), decoded))


def test_saved_weights_are_loaded_to_the_same_pictures(tmp_path):
    vae = make_vae("input_output")
    config = Config.preset("quick", data={"crop_bar": False}, vae={"stride": 3, "width": 4})
    save_vae(tmp_path / "v.safetensors", vae, config)
    loaded, metadata = load_vae(tmp_path / "v.safetensors")
    frame, difference, _ = make_batch()
    pair = loaded.reconstruct(frame, difference)[1], vae.reconstruct(frame, difference)[1]
    assert torch.allclose(*pair)
    assert metadata["crop_bar"] is False
    assert (metadata["vae"]["stride"], metadata["vae"]["width"]) == (3, 4)


def test_weights_of_another_kind_are_refused(quick_run):
    with pytest.raises(ValueError, match="holds 'mdn_rnn': expected a file of 'vae'"):
        load_vae(quick_run / "mdn_rnn.safetensors")


def test_weights_that_are_not_finite_are_refused(tmp_path):
    vae = make_vae("frame")
    vae.encoder[0].bias.data[1] = float("nan")
    save_vae(tmp_path / "v.safetensors", vae, Config.preset("quick", vae={"width": 4}))
    message = r"v.safetensors holds values that are not finite in 'encoder.0.bias': train it again"
    with pytest.raises(ValueError, match=message):
        load_vae(tmp_path / "v.safetensors")


@pytest.mark.parametrize(
    ("ours", "sizes", "pixels"),
    [(PixelDeconvolution, (64, 8, 5), 1), (ColourDeconvolution, (16, 6, 6), 30)],
)
def test_a_faster_deconvolution_equals_that_of_pytorch_and_so_do_its_gradients(ours, sizes, pixels):
    fast, plain = ours(*sizes, stride=2), nn.ConvTranspose2d(*sizes, stride=2)
    plain.load_state_dict(fast.state_dict())
    pictures = torch.randn(3, sizes[0], pixels, pixels)
    found = []
    for layer in (fast, plain):
        seen = pictures.clone().requires_grad_()
        made = layer(seen)
        (made**2).sum().backward()
        found.append([made, seen.grad, layer.weight.grad, layer.bias.grad])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-3)
