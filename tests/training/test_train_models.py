"""Training of V and of M: they learn, never from held-out episodes, and survive interrupts."""

import functools
import shutil

import numpy as np
import pytest
import torch

from stad_lab.config import Config
from stad_lab.io.files import load_json, load_tensors, save_json
from stad_lab.io.weights import load_mdn_rnn, load_vae
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.training import mdn_rnn as training_of_m
from stad_lab.training.dataset import Dataset, save_episode
from stad_lab.training.mdn_rnn import (
    Latents,
    check_lengths,
    fit_mdn_rnn,
    sequence_batch,
    train_mdn_rnn,
)
from stad_lab.training.trainer import torch_settings
from stad_lab.training.vae import train_vae

QUICK = Config.preset("quick")
FILES = {"vae": train_vae, "mdn_rnn": train_mdn_rnn}


@pytest.fixture
def data(quick_run):
    """A function that opens the dataset of the quick run."""
    return functools.partial(Dataset, quick_run / "dataset")


@pytest.fixture
def run_with_v(quick_run, tmp_path):
    """A function that makes a folder of a run with V alone."""

    def make(name):
        (tmp_path / name).mkdir()
        shutil.copy(quick_run / "vae.safetensors", tmp_path / name)
        return tmp_path / name

    return make


def reordered(quick_run, folder):
    """A function that opens another dataset: the same episodes in the opposite order."""
    shutil.copytree(quick_run / "dataset", folder)
    manifest = load_json(folder / "manifest.json")
    save_json(folder / "manifest.json", manifest | {"episodes": manifest["episodes"][::-1]})
    return functools.partial(Dataset, folder)


def same_weights(*files):
    """Whether two files have bit-identical tensors."""
    one, other = (load_tensors(file)[0] for file in files)
    return all(torch.equal(one[name], other[name]) for name in one | other)


def test_training_lowers_the_held_out_losses(quick_run):
    v = load_vae(quick_run / "vae.safetensors")[1]["history"]
    assert [entry["step"] for entry in v] == list(range(2, 41, 2))
    assert v[-1]["heldout"]["total"] < v[0]["heldout"]["total"]
    assert v[-1]["train"]["total"] < v[0]["train"]["total"]
    assert v[0]["train"].keys() == {"total", "frame_error", "difference_error", "kl"}
    m = load_mdn_rnn(quick_run / "mdn_rnn.safetensors")[1]["history"]
    assert [entry["step"] for entry in m] == list(range(1, 21))
    assert m[-1]["heldout"]["total"] < m[0]["heldout"]["total"]


def test_v_does_not_learn_from_held_out_episodes(data, quick_run, tmp_path):
    config = QUICK.replace(variant="frame", vae={"steps": 2, "batch": 200})
    other = shutil.copytree(quick_run / "dataset", tmp_path / "other")
    manifest = load_json(other / "manifest.json")
    last, rng = manifest["episodes"][-1], np.random.default_rng(0)
    noise = rng.integers(256, size=(last["frames"], 64, 64, 3), dtype=np.uint8)
    last |= save_episode(other, last["index"], (noise, Dataset(other).actions[-1], last["track"]))
    save_json(other / "manifest.json", manifest)
    folders = tmp_path / "first", tmp_path / "second"
    for opened, folder in zip((data, functools.partial(Dataset, other)), folders, strict=True):
        train_vae(config, opened, folder)
    files = [folder / "vae.safetensors" for folder in folders]
    first, second = (load_vae(file)[1]["history"][-1]["heldout"]["total"] for file in files)
    assert same_weights(*files)
    assert second > 2 * first


def test_a_training_interrupted_twice_equals_an_uninterrupted_one_bit_for_bit(
    data, tmp_path, interrupt_after
):
    config = QUICK.replace(variant="output", vae={"width": 4})
    one_go, interrupted = (tmp_path / name / "vae.safetensors" for name in ("one_go", "stopped"))
    for updates in (1, 17):  # before the first checkpoint, and between two of them
        with interrupt_after(updates):
            train_vae(config, data, interrupted.parent)
        assert not interrupted.exists()
    for file in (one_go, interrupted):
        assert train_vae(config, data, file.parent)
    assert one_go.read_bytes() == interrupted.read_bytes()
    left = [file.name for file in interrupted.parent.glob("[!.]*")]
    assert left == ["vae.safetensors"]  # no checkpoint


def test_an_interrupted_training_of_m_equals_an_uninterrupted_one_bit_for_bit(
    data, run_with_v, interrupt_after
):
    config = QUICK.replace(mdn_rnn={"steps": 60})
    one_go, interrupted = (run_with_v(name) / "mdn_rnn.safetensors" for name in ("one", "stopped"))
    with interrupt_after(32):  # between two checkpoints, which come every third step
        train_mdn_rnn(config, data, interrupted.parent)
    assert not interrupted.exists()
    for file in (one_go, interrupted):
        assert train_mdn_rnn(config, data, file.parent)
    assert one_go.read_bytes() == interrupted.read_bytes()


def test_a_loss_that_is_not_finite_stops_the_training(data, tmp_path):
    extreme = {"width": 4, "difference_weight": 1e12, "kl_weight": 1e12, "learning_rate": 1e6}
    config = QUICK.replace(variant="output", vae=extreme)
    message = r"train V .output.: the loss is .* in step .*lower the learning rate"
    with pytest.raises(FloatingPointError, match=message):
        train_vae(config, data, tmp_path)


def test_v_and_m_of_another_dataset_are_refused(quick_run, run_with_v, tmp_path, interrupt_after):
    other = reordered(quick_run, tmp_path / "other")
    with pytest.raises(ValueError, match=r"vae.safetensors was trained on another dataset"):
        train_mdn_rnn(QUICK, other, run_with_v("run"))
    config = QUICK.replace(variant="frame", vae={"steps": 20})
    with interrupt_after(5):
        train_vae(config, functools.partial(Dataset, quick_run / "dataset"), tmp_path / "v")
    with pytest.raises(ValueError, match=r"vae.training.safetensors was made with dataset="):
        train_vae(config, other, tmp_path / "v")


@pytest.mark.parametrize(
    ("name", "stage", "setting", "value"),
    [("vae", "vae", "kl_weight", 16.0), ("mdn_rnn", "mdn_rnn", "learning_rate", 0.5)],
)
def test_v_and_m_of_another_configuration_are_refused(
    name, stage, setting, value, data, quick_run, run_with_v
):
    folder = run_with_v("run")
    shutil.copy(quick_run / "mdn_rnn.safetensors", folder)
    message = rf"{name}.safetensors was made with {stage}.{setting}=.*now {stage}.{setting}={value}"
    with pytest.raises(ValueError, match=message):
        FILES[name](QUICK.replace(**{stage: {setting: value}}), data, folder)


def test_a_checkpoint_that_a_killed_process_left_behind_is_cleared_away(
    data, quick_run, run_with_v
):
    folder = run_with_v("run")
    shutil.copy(quick_run / "mdn_rnn.safetensors", folder)
    for name, train in FILES.items():
        left_over = folder / f"{name}.training.safetensors"
        left_over.write_bytes(b"state")
        assert not train(QUICK, data, folder)
        assert not left_over.exists()


def test_no_steps_leave_m_with_its_initial_weights(data, run_with_v, monkeypatch):
    config, folder = QUICK.replace(mdn_rnn={"steps": 0}), run_with_v("run")
    monkeypatch.setattr(training_of_m, "encode_dataset", None)  # V need not encode anything
    assert train_mdn_rnn(config, data, folder)
    assert not train_mdn_rnn(config, data, folder)
    untrained, metadata = load_mdn_rnn(folder / "mdn_rnn.safetensors")
    with torch_settings(config.seed, 1):
        fresh = MDNRNN(32, config.mdn_rnn.hidden_size, config.mdn_rnn.mixtures)
    assert metadata["history"] == []
    pairs = zip(untrained.state_dict().values(), fresh.state_dict().values(), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)


def test_sequences_are_stretches_of_one_episode_and_z_is_sampled_each_time():
    lengths = 9, 30, 12
    numbers = [np.float32(100 * index + np.arange(n)) for index, n in enumerate(lengths)]
    actions = [np.repeat(one[:, None], 3, 1) for one in numbers]
    encoded = [np.full((2, n, 2), -30.0, np.float32) for n in lengths]  # hardly any noise
    for one, number in zip(encoded, numbers, strict=True):
        one[0] = number[:, None]
    z, chosen = sequence_batch(encoded, actions, 10, 200, np.random.default_rng(0))
    assert (z.shape, chosen.shape) == ((200, 11, 2), (200, 10, 3))
    assert torch.equal(z[:, :-1, 0].round(), chosen[:, :, 0])  # actions belong to their z
    assert ((z[:, 1:] - z[:, :-1]).round() == 1).all()  # in order, within one episode
    starts = set(z[:, 0, 0].round().int().tolist())
    assert starts == {*range(100, 120), 200, 201}  # every one that fits
    encoded[1][1] = encoded[2][1] = 0  # deviation 1
    rngs = [np.random.default_rng(seed) for seed in (0, 0, 1)]
    first, again, other = (sequence_batch(encoded, actions, 10, 50, rng) for rng in rngs)
    assert torch.equal(first[0], again[0])
    assert not torch.equal(first[0], other[0])
    assert (first[0][:, :-1, 0] - first[1][..., 0]).std() > 0.8


def test_sequences_longer_than_every_episode_are_refused():
    encoded, actions = [np.zeros((2, 20, 2), np.float32)], [np.zeros((20, 3), np.float32)]
    message = "mdn_rnn.sequence=20, but the longest episode has 20 frames: use shorter sequences"
    with pytest.raises(ValueError, match=message):
        sequence_batch(encoded, actions, 20, 1, np.random.default_rng(0))


@pytest.mark.parametrize(("lengths", "which"), [((30, 10), "held-out"), ((10, 30), "training")])
def test_a_training_without_a_sequence_for_both_losses_is_refused(lengths, which):
    class Two:
        """A dataset of two episodes, of which the second is held out."""

        episode, first_heldout = np.repeat([0, 1], lengths), 1

    message = f"mdn_rnn.sequence=20, but the longest {which} episode has 10 frames: use shorter"
    with pytest.raises(ValueError, match=message):
        check_lengths(Two(), 20)


def fit_made_up(path, heldout=0.0):
    """Train an M on made-up episodes whose next z is the sign of the steering.

    Args:
        heldout: is added to z of the held-out episode.
    """
    rng = np.random.default_rng(0)
    actions = [rng.choice([-1.0, 1.0], (40, 3)).astype(np.float32) for _ in range(12)]
    z = [np.vstack([np.zeros((1, 32)), np.repeat(one[:-1, :1], 32, axis=1)]) for one in actions]
    encoded = [np.stack([one, np.full((40, 32), -8.0)]).astype(np.float32) for one in z]
    encoded[-1][0] += heldout
    settings = {"hidden_size": 16, "sequence": 20, "steps": 60, "learning_rate": 2e-2}
    with torch_settings(0, 1) as device:
        latents = Latents(encoded, actions, 11, "v")
        fit_mdn_rnn(QUICK.replace(mdn_rnn=settings), latents, path, device)
    return *load_mdn_rnn(path), actions[-1], encoded[-1][0]


def test_m_learns_what_comes_next(tmp_path):
    mdn_rnn, _, actions, z = fit_made_up(tmp_path / "m.safetensors")
    mixture, _ = mdn_rnn(torch.from_numpy(z)[None], torch.from_numpy(actions)[None])
    expected = (mixture.logpi.exp() * mixture.mean).sum(-1)[0, :, 0]
    assert np.corrcoef(expected.detach(), actions[:, 0])[0, 1] > 0.9


def test_m_does_not_learn_from_held_out_episodes(tmp_path):
    files = [tmp_path / name for name in ("one.safetensors", "other.safetensors")]
    first, second = (
        fit_made_up(file, heldout)[1]["history"][-1]["heldout"]["total"]
        for file, heldout in zip(files, (0.0, 5.0), strict=True)
    )
    assert same_weights(*files)
    assert second > first + 1


def test_every_step_of_m_sees_other_sequences(tmp_path, monkeypatch):
    batches = []

    def noting(*given):
        batches.append(sequence_batch(*given))
        return batches[-1]

    monkeypatch.setattr(training_of_m, "sequence_batch", noting)
    fit_made_up(tmp_path / "m.safetensors")
    batches = [z for z, _ in batches if len(z) == QUICK.mdn_rnn.batch]  # held-out ones are larger
    assert len(batches) == len({z.numpy().tobytes() for z in batches}) == 60
