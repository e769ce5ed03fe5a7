"""V: four variants, the loss term by term, and a training that an interrupt does not change."""

import shutil

import numpy as np
import pytest
import torch

from stad_lab.config import Settings
from stad_lab.envs.frames import difference_image
from stad_lab.io.files import load_json, load_tensors, save_json
from stad_lab.models.mdn_rnn import train_mdn_rnn
from stad_lab.models.vae import (
    VARIANTS,
    AutoEncoder,
    FromOnePixel,
    ToColours,
    autoencoder_losses,
    load_autoencoder,
    save_autoencoder,
    to_pictures,
    train_autoencoder,
)
from stad_lab.training.dataset import Rollouts, save_block


def make_autoencoder(variant, seed=0, width=4):
    """A small V with fixed random weights."""
    torch.manual_seed(seed)
    return AutoEncoder(variant, latent_size=32, width=width)


def make_batch(count=3, seed=0):
    """Frames, difference images and noise."""
    rng = np.random.default_rng(seed)
    frames, earlier = rng.integers(0, 256, (2, count, 64, 64, 3), np.uint8)
    return *to_pictures(frames, earlier), torch.from_numpy(
        rng.standard_normal((count, 32), np.float32)
    )


@pytest.mark.parametrize(
    ("ours", "general", "size", "drawn"),
    [
        (FromOnePixel(8, 6, 5), torch.nn.ConvTranspose2d(8, 6, 5), 1, 5),
        (ToColours(8, 3), torch.nn.ConvTranspose2d(8, 3, 6, stride=2), 30, 64),
    ],
)
def test_the_decoder_s_own_layers_are_transposed_convolutions(ours, general, size, drawn):
    torch.manual_seed(0)
    general.load_state_dict(ours.state_dict())
    pictures, wanted = (
        torch.randn(3, 8, size, size),
        torch.randn(3, ours.out_channels, drawn, drawn),
    )
    results = []
    for layer in (ours, general):
        seen = pictures.clone().requires_grad_()
        (layer(seen) * wanted).sum().backward()
        results.append([layer(pictures), seen.grad, layer.weight.grad, layer.bias.grad])
    for one, other in zip(*results, strict=True):
        assert one.shape == other.shape
        assert torch.allclose(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_pictures_weights_and_losses_stay_on_one_device(variant):
    # "meta" is a device without numbers: it refuses a mixture of devices as a GPU does, and needs none.
    autoencoder = make_autoencoder(variant).to("meta", memory_format=torch.channels_last)
    frames = np.zeros((3, 64, 64, 3), np.uint8)
    frame, difference = to_pictures(frames, frames, "meta")
    losses = autoencoder_losses(
        autoencoder, frame, difference, torch.zeros(3, 32, device="meta"), Settings()
    )
    losses["total"].backward()
    assert {loss.device.type for loss in losses.values()} == {"meta"}
    assert {parameter.grad.device.type for parameter in autoencoder.parameters()} == {"meta"}


def test_frames_that_are_no_bytes_are_refused_and_stay_what_they_are():
    frames = np.full((2, 64, 64, 3), 255, np.float32)
    with pytest.raises(
        ValueError, match=r"\(2, 64, 64, 3\) float32 .*: expected two uint8 arrays of one shape"
    ):
        to_pictures(frames, frames)
    assert (frames == 255).all()


@pytest.mark.parametrize(
    ("variant", "seen", "redrawn"),
    [("frame", 3, 3), ("input", 6, 3), ("output", 3, 6), ("input_output", 6, 6)],
)
def test_each_variant_sees_and_redraws_its_pictures(variant, seen, redrawn):
    autoencoder = make_autoencoder(variant)
    frame, difference, _ = make_batch()
    assert autoencoder.encoder[0].in_channels == seen
    assert autoencoder.decoder[-1].out_channels == redrawn
    mu, logvar = autoencoder.encode(frame, difference)
    assert mu.shape == logvar.shape == (3, 32)
    sees_difference = not torch.equal(mu, autoencoder.encode(frame, -difference)[0])
    assert sees_difference == (seen == 6)
    drawn_frame, drawn_difference = autoencoder.decode(mu)
    assert drawn_frame.shape == frame.shape
    assert 0 <= drawn_frame.min() <= drawn_frame.max() <= 1
    if redrawn == 3:
        assert drawn_difference is None
    else:
        assert drawn_difference.shape == difference.shape
        assert -1 <= drawn_difference.min() < 0 < drawn_difference.max() <= 1


def test_the_four_variants_are_those_of_the_paper():
    assert VARIANTS == ("frame", "input", "output", "input_output")


def test_an_unknown_variant_is_refused_with_the_choices():
    with pytest.raises(
        ValueError, match="unknown variant 'both': choose one of frame, input, output, input_output"
    ):
        AutoEncoder("both")


def test_a_drawn_difference_can_be_as_negative_as_it_can_be_positive():
    autoencoder = make_autoencoder("output")
    last = autoencoder.decoder[-1]
    for bias in (-50.0, 50.0):
        last.bias.data.fill_(bias)
        frame, difference = (drawn.detach() for drawn in autoencoder.decode(torch.zeros(1, 32)))
        assert frame.mean() == pytest.approx(0 if bias < 0 else 1)
        assert difference.mean() == pytest.approx(-1 if bias < 0 else 1)


def test_pictures_are_the_frames_and_differences_as_floats():
    frames, earlier = np.random.default_rng(0).integers(0, 256, (2, 3, 64, 64, 3), np.uint8)
    frame, difference = to_pictures(frames, earlier)
    assert frame.shape == difference.shape == (3, 3, 64, 64)
    assert np.allclose(frame.permute(0, 2, 3, 1), frames / 255, atol=1e-6)
    assert np.allclose(difference.permute(0, 2, 3, 1), difference_image(frames, earlier), atol=1e-6)


def test_kl_is_that_of_torch_distributions():
    autoencoder = make_autoencoder("input")
    autoencoder.encoder[-1].weight.data *= 30  # far from N(0, 1)
    frame, difference, noise = make_batch()
    mu, logvar = autoencoder.encode(frame, difference)
    normal = torch.distributions.Normal
    expected = (
        torch.distributions.kl_divergence(normal(mu, torch.exp(logvar / 2)), normal(0.0, 1.0))
        .sum(1)
        .mean()
    )
    kl = autoencoder_losses(autoencoder, frame, difference, noise, Settings())["kl"]
    assert kl > 1
    assert torch.allclose(kl, expected, rtol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("floor", ["none", "above some pictures and below others"])
def test_the_loss_is_the_plain_sum_of_its_named_terms(variant, floor):
    autoencoder = make_autoencoder(variant)
    autoencoder.encoder[
        -1
    ].weight.data *= 100  # some 60 nats of KL, so that each nat counts in the total
    autoencoder.decoder[0].weight.data *= 30  # and z in the drawing
    frame, difference, noise = make_batch()
    mu, logvar = (part.detach().double().numpy() for part in autoencoder.encode(frame, difference))
    z = mu + np.sqrt(np.exp(logvar)) * noise.numpy()
    drawn = [
        None if d is None else d.detach().numpy()
        for d in autoencoder.decode(torch.from_numpy(z).float())
    ]
    kl = [
        sum(0.5 * (m**2 + np.exp(v) - 1 - v) for m, v in zip(*row, strict=True))
        for row in zip(mu, logvar)
    ]
    free_bits = 0.0 if floor == "none" else float(np.median(kl)) / 32
    settings = Settings(kl_weight=0.7, difference_weight=3.0, free_bits=free_bits)
    losses = autoencoder_losses(autoencoder, frame, difference, noise, settings)
    expected = {"kl": np.mean(kl), "frame_error": ((drawn[0] - frame.numpy()) ** 2).sum() / 3}
    total = expected["frame_error"] + 0.7 * np.mean([max(one, free_bits * 32) for one in kl])
    if "output" in variant:
        expected["difference_error"] = ((drawn[1] - difference.numpy()) ** 2).sum() / 3
        total += 3.0 * expected["difference_error"]
    expected["total"] = total
    assert {name: loss.item() for name, loss in losses.items()} == pytest.approx(expected, rel=1e-5)


def gradient(settings):
    """The gradient of the loss with respect to the encoder's last weights."""
    autoencoder = make_autoencoder("input")
    autoencoder_losses(autoencoder, *make_batch(), settings)["total"].backward()
    return autoencoder.encoder[-1].weight.grad


def test_under_the_floor_of_free_bits_the_kl_has_no_gradient():
    without_kl = gradient(Settings(kl_weight=0.0))
    assert torch.equal(gradient(Settings(kl_weight=100.0, free_bits=5.0)), without_kl)
    assert not torch.equal(gradient(Settings(kl_weight=100.0, free_bits=0.0)), without_kl)


def test_the_noise_is_reparameterised():
    autoencoder = make_autoencoder("frame")
    frame, difference, noise = make_batch()
    settings = Settings(kl_weight=0.0)
    silent = autoencoder_losses(autoencoder, frame, difference, torch.zeros_like(noise), settings)[
        "total"
    ]
    redrawn = autoencoder.reconstruct(frame, difference)[0]
    assert torch.allclose(silent, ((redrawn - frame) ** 2).sum() / 3)
    noisy = autoencoder_losses(autoencoder, frame, difference, noise, settings)["total"]
    assert noisy != silent
    noisy.backward()
    mu_rows, logvar_rows = autoencoder.encoder[-1].weight.grad.chunk(2)
    assert mu_rows.abs().max() > 0
    assert logvar_rows.abs().max() > 0


def test_reconstruct_decodes_the_mean_and_repeats_itself():
    autoencoder = make_autoencoder("input_output")
    frame, difference, _ = make_batch()
    decoded = autoencoder.decode(autoencoder.encode(frame, difference)[0])
    for redrawn in (
        autoencoder.reconstruct(frame, difference),
        autoencoder.reconstruct(frame, difference),
    ):
        assert torch.equal(redrawn[0], decoded[0])
        assert torch.equal(redrawn[1], decoded[1])


def test_training_lowers_the_held_out_loss(quick_run):
    history = load_autoencoder(quick_run / "autoencoder.safetensors")[1]["history"]
    assert [entry["step"] for entry in history] == list(range(2, 41, 2))
    assert history[-1]["heldout"]["total"] < history[0]["heldout"]["total"]
    assert history[-1]["train"]["total"] < history[0]["train"]["total"]
    assert history[0]["train"].keys() == {"total", "frame_error", "difference_error", "kl"}


def test_v_does_not_learn_from_held_out_episodes(quick_run, tmp_path):
    settings, weights, losses = Settings.preset("quick", v_steps=2, v_batch=200), [], []
    other = shutil.copytree(quick_run / "rollouts", tmp_path / "other")
    manifest = load_json(other / "manifest.json")
    last = manifest["blocks"][-1]
    noise = np.random.default_rng(0).integers(256, size=(last["frames"], 64, 64, 3), dtype=np.uint8)
    last |= save_block(other, last["index"], noise, Rollouts(other).actions[-1], last["track"])
    save_json(other / "manifest.json", manifest)
    for rollouts in (quick_run / "rollouts", other):
        train_autoencoder("frame", settings, rollouts, tmp_path / f"of {rollouts.name}")
        tensors, facts = load_tensors(tmp_path / f"of {rollouts.name}" / "autoencoder.safetensors")
        weights.append(tensors)
        losses.append(facts["history"][-1]["heldout"]["total"])
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0] | weights[1])
    assert losses[1] > 2 * losses[0]


def test_a_training_interrupted_twice_equals_an_uninterrupted_one_bit_for_bit(
    quick_run, tmp_path, interrupt_after
):
    settings = Settings.preset("quick", width=4)
    for updates in (1, 17):  # before the first checkpoint, and between two of them
        hook = interrupt_after(updates)
        with pytest.raises(KeyboardInterrupt):
            train_autoencoder("output", settings, quick_run / "rollouts", tmp_path / "interrupted")
        hook.remove()
        assert not (tmp_path / "interrupted" / "autoencoder.safetensors").exists()
    for folder in ("one_go", "interrupted"):
        assert train_autoencoder("output", settings, quick_run / "rollouts", tmp_path / folder)
    files = [tmp_path / folder / "autoencoder.safetensors" for folder in ("one_go", "interrupted")]
    (one_go, one_go_facts), (resumed, resumed_facts) = (load_tensors(file) for file in files)
    assert all(torch.equal(one_go[name], resumed[name]) for name in one_go | resumed)
    assert one_go_facts == resumed_facts
    assert files[0].read_bytes() == files[1].read_bytes()
    assert [file.name for file in files[1].parent.glob("[!.]*")] == [
        "autoencoder.safetensors"
    ]  # no checkpoint is left


def test_a_loss_that_is_not_finite_stops_the_training(quick_run, tmp_path):
    settings = Settings.preset(
        "quick", width=4, difference_weight=1e12, kl_weight=1e12, v_learning_rate=1e6
    )
    with pytest.raises(
        FloatingPointError,
        match=r"train V .output.: the loss is .* in step .*lower the learning rate",
    ):
        train_autoencoder("output", settings, quick_run / "rollouts", tmp_path)


def test_v_and_m_of_other_rollouts_are_refused(quick_run, tmp_path):
    manifest = load_json(quick_run / "rollouts" / "manifest.json")
    save_json(tmp_path / "manifest.json", manifest | {"blocks": manifest["blocks"][::-1]})
    for train in (train_autoencoder, train_mdn_rnn):
        with pytest.raises(
            ValueError, match=r".safetensors was trained on other rollouts than those in"
        ):
            train("input_output", Settings.preset("quick"), tmp_path, quick_run)


def test_v_and_m_of_other_settings_are_refused(quick_run, tmp_path):
    changes = (
        ("autoencoder", train_autoencoder, "kl_weight", 16.0),
        ("mdn_rnn", train_mdn_rnn, "m_learning_rate", 0.5),
    )
    for part, train, name, value in changes:
        shutil.copy(quick_run / f"{part}.safetensors", tmp_path)
        with pytest.raises(
            ValueError, match=rf"{part}.safetensors holds a run with {name}=.*now {name}={value}"
        ):
            train(
                "input_output",
                Settings.preset("quick", **{name: value}),
                quick_run / "rollouts",
                tmp_path,
            )


def test_a_training_state_that_a_killed_process_left_behind_is_cleared_away(quick_run, tmp_path):
    for part, train in (("autoencoder", train_autoencoder), ("mdn_rnn", train_mdn_rnn)):
        shutil.copy(quick_run / f"{part}.safetensors", tmp_path)
        left_over = tmp_path / f"{part}.training.safetensors"
        left_over.write_bytes(b"state")
        assert not train("input_output", Settings.preset("quick"), quick_run / "rollouts", tmp_path)
        assert not left_over.exists()


def test_saved_weights_are_loaded_to_the_same_pictures(tmp_path):
    autoencoder = make_autoencoder("input_output")
    save_autoencoder(
        tmp_path / "v.safetensors", autoencoder, Settings(stride=3, crop_bar=False), []
    )
    loaded, facts = load_autoencoder(tmp_path / "v.safetensors", "input_output")
    frame, difference, _ = make_batch()
    assert torch.allclose(
        loaded.reconstruct(frame, difference)[1], autoencoder.reconstruct(frame, difference)[1]
    )
    assert (facts["stride"], facts["crop_bar"], facts["width"]) == (3, False, 4)


def test_weights_of_another_variant_are_refused(quick_run):
    with pytest.raises(
        ValueError,
        match="holds variant 'input_output', and 'frame' was asked for: give its own run",
    ):
        load_autoencoder(quick_run / "autoencoder.safetensors", "frame")


def test_weights_of_another_part_are_refused(quick_run):
    with pytest.raises(ValueError, match="holds 'mdn_rnn': expected 'autoencoder'"):
        load_autoencoder(quick_run / "mdn_rnn.safetensors")


def test_weights_that_are_not_finite_are_refused(tmp_path):
    autoencoder = make_autoencoder("frame")
    autoencoder.encoder[0].bias.data[1] = float("nan")
    save_autoencoder(tmp_path / "v.safetensors", autoencoder, Settings(), [])
    with pytest.raises(
        ValueError,
        match=r"v.safetensors holds values that are not finite in 'encoder.0.bias': train",
    ):
        load_autoencoder(tmp_path / "v.safetensors")


def test_v_does_not_go_on_with_other_rollouts(quick_run, tmp_path, interrupt_after):
    settings = Settings.preset("quick", v_steps=20)
    interrupt_after(5)
    with pytest.raises(KeyboardInterrupt):
        train_autoencoder("frame", settings, quick_run / "rollouts", tmp_path / "run")
    other = shutil.copytree(quick_run / "rollouts", tmp_path / "other")
    manifest = load_json(other / "manifest.json")
    save_json(other / "manifest.json", manifest | {"blocks": manifest["blocks"][::-1]})
    with pytest.raises(ValueError, match="holds a run with rollouts="):
        train_autoencoder("frame", settings, other, tmp_path / "run")
