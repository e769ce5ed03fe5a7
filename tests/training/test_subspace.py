"""Where C is searched: along every weight that it may have, or along the principal components of what it sees."""

import dataclasses
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from stad_lab.agent import WorldModel, load_controller, read_world_model
from stad_lab.config import Settings
from stad_lab.evaluation.verify import verify
from stad_lab.io.files import load_json, save_tensors
from stad_lab.models.controller import control, seen_columns
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import AutoEncoder
from stad_lab.training.dataset import Rollouts, collect_rollouts
from stad_lab.training.evolution import averaged_mean, evolve, replay
from stad_lab.training.pipeline import ship, train
from stad_lab.training.subspace import (
    COMPONENTS,
    START,
    features,
    find_components,
    principal_components,
    save_start,
    search_space,
)

VARIANT = "input_output"
SETTINGS = Settings.preset("quick", components=5, sigma_decay=0.9, processes=1)


@pytest.fixture(scope="module")
def searched(quick_run, tmp_path_factory):
    """A quick run whose C was searched along five components."""
    folder = tmp_path_factory.mktemp("components") / "run"
    for name in ("autoencoder", "mdn_rnn"):
        folder.mkdir(exist_ok=True)
        shutil.copy(quick_run / f"{name}.safetensors", folder)
    with ThreadPoolExecutor(1) as executor:
        assert train(VARIANT, SETTINGS, folder, quick_run / "rollouts", executor=executor)
    return folder


def random_drives(columns, lengths=(40, 60), scales=None):
    """What C might see in some episodes: correlated numbers, around a middle that is not zero."""
    rng = np.random.default_rng(0)
    mixed = (
        rng.standard_normal((columns, columns))
        * (np.ones(columns) if scales is None else scales)[:, None]
    )
    return [
        (rng.standard_normal((length, columns)) @ mixed + 3).astype(np.float32)
        for length in lengths
    ]


def test_the_components_are_those_of_largest_variance_over_all_episodes():
    drives = random_drives(8, scales=np.array([5, 4, 3, 2, 1, 0.1, 0.1, 0.1]))
    middle, components = principal_components(drives, np.ones(8, bool), 4)
    seen = np.concatenate(drives).astype(float)
    assert middle == pytest.approx(seen.mean(axis=0))
    _, _, expected = np.linalg.svd(seen - seen.mean(axis=0))
    assert np.abs(components @ expected[:4].T) == pytest.approx(
        np.eye(4), abs=1e-6
    )  # the sign is free


@pytest.mark.parametrize(
    ("sees", "columns"), [("z", slice(3)), ("h", slice(3, 8)), ("z, h", slice(0, 8))]
)
def test_what_c_may_not_see_has_no_weight(quick_run, sees, columns):
    drives, seen = random_drives(8), seen_columns(sees, 3, 5)
    _, components = principal_components(drives, seen, 100)
    assert components.shape == (seen.sum(), 8) and np.linalg.matrix_rank(components) == seen.sum()
    assert (np.delete(components, columns, axis=1) == 0).all()
    space = search_space(
        Settings.preset("quick", features=sees), read_world_model(quick_run, VARIANT), quick_run
    )
    whole = space.expand(np.ones(len(space.first)))
    weights = whole[:-3].reshape(3, 56)
    hidden = {"z": slice(32, 56), "h": slice(32), "z, h": slice(0)}[sees]
    assert (
        (weights[:, hidden] == 0).all()
        and (np.delete(weights, hidden, axis=1) == 1).all()
        and (whole[-3:] == 1).all()
    )


def test_a_c_of_the_components_does_what_its_weights_say(searched, quick_run):
    world_model = read_world_model(searched, VARIANT)
    space = search_space(SETTINGS, world_model, searched)
    rollouts = Rollouts(quick_run / "rollouts")
    drives = zip(rollouts.frames, rollouts.actions, strict=True)
    seen = np.concatenate([features(world_model, *drive) for drive in drives])
    middle, components = principal_components([seen], np.ones(56, bool), 5)
    found = np.random.default_rng(0).standard_normal(3 * 5 + 3)
    raw = (
        (seen - middle) @ components.T @ found[:15].reshape(3, 5).T
        + found[15:]
        + [0, SETTINGS.initial_gas, 0]
    )
    steering = control(space.expand(found), seen)[:, 0]
    assert steering.std() > 0.02 and steering == pytest.approx(np.tanh(raw[:, 0]), abs=1e-3)


def test_the_search_begins_with_the_first_controller_and_keeps_an_ordinary_one(searched):
    log = load_json(searched / "evolution.json")
    space = search_space(SETTINGS, read_world_model(searched, VARIANT), searched)
    start = space.expand(space.first)
    assert (start[:-3] == 0).all() and start[-3:].tolist() == [0, SETTINGS.initial_gas, 0]
    _, means = replay(space.first, SETTINGS, log["generations"][: log["best"]["generation"]])
    parameters, _ = load_controller(searched / "controller.safetensors", VARIANT)
    assert np.array_equal(parameters, space.expand(averaged_mean(means, SETTINGS)))
    assert [len(mean) for mean in means] == [18] * len(means) and np.ptp(parameters) > 0


def test_components_are_found_once_and_belong_to_their_v_and_m(searched, quick_run, tmp_path):
    assert not find_components(VARIANT, SETTINGS, quick_run / "rollouts", searched)
    assert not find_components(VARIANT, Settings.preset("quick"), quick_run / "rollouts", quick_run)
    assert not (quick_run / "components.safetensors").exists()
    other = shutil.copytree(searched, tmp_path / "other")
    (other / "components.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"components\.safetensors"):
        search_space(SETTINGS, read_world_model(other, VARIANT), other)
    assert find_components(VARIANT, SETTINGS, quick_run / "rollouts", other)
    assert (other / "components.safetensors").read_bytes() == (
        searched / "components.safetensors"
    ).read_bytes()


def test_a_file_under_the_name_of_another_part_is_refused(searched, tmp_path):
    folder, world_model = (
        shutil.copytree(searched, tmp_path / "run"),
        read_world_model(searched, VARIANT),
    )
    shutil.copy(folder / "components.safetensors", folder / "start.safetensors")
    with pytest.raises(ValueError, match="holds 'components': expected 'start'"):
        search_space(SETTINGS, world_model, folder)
    (folder / "start.safetensors").unlink()
    shutil.copy(folder / "mdn_rnn.safetensors", folder / "components.safetensors")
    with pytest.raises(ValueError, match="holds 'mdn_rnn': expected 'components'"):
        search_space(SETTINGS, world_model, folder)


def test_a_search_does_not_go_on_along_other_components(searched, quick_run, tmp_path):
    folder, other = (shutil.copytree(searched, tmp_path / name) for name in ("run", "other"))
    (other / "components.safetensors").unlink()
    fewer = Settings.preset(
        "quick", episodes=4
    )  # the components of other rollouts, for the same V and M
    collect_rollouts(fewer, tmp_path / "rollouts")
    assert find_components(VARIANT, SETTINGS, tmp_path / "rollouts", other)
    shutil.copy(other / "components.safetensors", folder)
    before = (folder / "evolution.json").read_bytes()
    with pytest.raises(ValueError, match="holds other components, or another start"):
        evolve(VARIANT, dataclasses.replace(SETTINGS, generations=6), folder)
    assert (folder / "evolution.json").read_bytes() == before
    assert verify(folder)["log of CMA-ES"].startswith("FAILED")


def test_a_run_along_components_is_verified_shipped_and_verified_again(searched, tmp_path):
    for folder in (searched, ship(VARIANT, searched, tmp_path)):
        found = verify(folder)
        assert found["log of CMA-ES"] == "ok: 4 generations lead to the same mean", found
        assert not any(outcome.startswith("FAILED") for outcome in found.values()), found


def test_a_search_along_components_begins_at_the_start_too(tmp_path):
    identities = {"autoencoder": "v", "mdn_rnn": "m"}
    world_model = WorldModel(AutoEncoder("input", 4, 4), MDNRNN(4, 8, 3), 4, True, identities)
    start = np.arange(39.0)
    save_start(tmp_path / START, start, "input", world_model)
    parts = {"middle": torch.ones(12).double(), "components": torch.eye(12).double()[:5]}
    save_tensors(tmp_path / COMPONENTS, parts, part="components", variant="input", **identities)
    for components in (5, 0):
        space = search_space(Settings.preset("quick", components=components), world_model, tmp_path)
        assert np.array_equal(space.expand(space.first), start)
