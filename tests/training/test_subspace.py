"""Where CMA-ES searches for C: along its weights, or along the components of what it sees."""

import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from stad_lab.config import Config
from stad_lab.evaluation.verify import verify
from stad_lab.features import features_of
from stad_lab.io.files import load_json, save_tensors
from stad_lab.io.weights import WorldModel, load_controller, load_world_model
from stad_lab.models.controller import control, seen_columns
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training import subspace
from stad_lab.training.dataset import Dataset, collect
from stad_lab.training.evolution import LOG, averaged_mean, evolve, replay
from stad_lab.training.pipeline import train
from stad_lab.training.subspace import (
    COMPONENTS_FILE,
    START_FILE,
    find_components,
    principal_components,
    save_start,
    search_space,
)
from stad_study.ship import ship

QUICK = Config.preset("quick")
CONFIG = QUICK.replace(evolution={"components": 5, "sigma_decay": 0.9}, processes=1)


@pytest.fixture(scope="module")
def dataset(quick_run):
    """A function that opens the dataset of the quick run, as the stages are given it."""
    opened = Dataset(quick_run / "dataset")
    return lambda: opened


@pytest.fixture(scope="module")
def searched(quick_run, tmp_path_factory):
    """A quick run whose C was searched along five components."""
    folder = tmp_path_factory.mktemp("components") / "run"
    folder.mkdir()
    for name in ("vae", "mdn_rnn"):
        shutil.copy(quick_run / f"{name}.safetensors", folder)
    with ThreadPoolExecutor(1) as executor:
        assert train(CONFIG, folder, quick_run / "dataset", executor=executor)
    return folder


def random_features(columns, scales=1.0):
    """What C might see in two episodes: correlated numbers whose mean is not zero."""
    rng = np.random.default_rng(0)
    mixed = rng.standard_normal((columns, columns)) * (np.ones(columns) * scales)[:, None]
    whole = [rng.standard_normal((length, columns)) @ mixed + 3 for length in (40, 60)]
    return [one.astype(np.float32) for one in whole]


def test_the_components_are_the_directions_of_largest_variance_over_all_episodes():
    episodes = random_features(8, np.array([5, 4, 3, 2, 1, 0.1, 0.1, 0.1]))
    middle, components = principal_components(episodes, np.ones(8, bool), 4)
    seen = np.concatenate(episodes).astype(float)
    assert middle == pytest.approx(seen.mean(axis=0))
    _, _, expected = np.linalg.svd(seen - seen.mean(axis=0))
    signs = np.abs(components @ expected[:4].T)  # the sign of a component is free
    assert signs == pytest.approx(np.eye(4), abs=1e-6)


@pytest.mark.parametrize(
    ("sees", "columns", "hidden"),
    [
        ("z", slice(3), slice(32, 56)),
        ("h", slice(3, 8), slice(32)),
        ("z, h", slice(0, 8), slice(0)),
    ],
)
def test_what_c_may_not_see_has_no_weight(quick_run, sees, columns, hidden):
    seen = seen_columns(sees, 3, 5)
    _, components = principal_components(random_features(8), seen, 100)
    assert components.shape == (seen.sum(), 8) and np.linalg.matrix_rank(components) == seen.sum()
    assert (np.delete(components, columns, axis=1) == 0).all()
    config = QUICK.replace(evolution={"features": sees})
    space = search_space(config, load_world_model(quick_run), quick_run)
    whole = space.expand(np.ones(len(space.first)))
    weights = whole[:-3].reshape(3, 56)
    assert (weights[:, hidden] == 0).all() and (whole[-3:] == 1).all()
    assert (np.delete(weights, hidden, axis=1) == 1).all()


def test_a_c_of_the_components_acts_as_its_weights_along_them_say(searched, dataset):
    world_model = load_world_model(searched)
    space = search_space(CONFIG, world_model, searched)
    episodes = zip(dataset().frames, dataset().actions, strict=True)
    seen = np.concatenate([features_of(world_model, *episode) for episode in episodes])
    middle, components = principal_components([seen], np.ones(56, bool), 5)
    found = np.random.default_rng(0).standard_normal(3 * 5 + 3)
    along = (seen - middle) @ components.T @ found[:15].reshape(3, 5).T
    raw = along + found[15:] + [0, CONFIG.evolution.initial_gas, 0]
    steering = control(space.expand(found), seen)[:, 0]
    assert steering.std() > 0.02 and steering == pytest.approx(np.tanh(raw[:, 0]), abs=1e-3)


def test_the_run_begins_with_the_first_controller_and_keeps_an_ordinary_one(searched):
    log, gas = load_json(searched / LOG), CONFIG.evolution.initial_gas
    space = search_space(CONFIG, load_world_model(searched), searched)
    start = space.expand(space.first)
    assert (start[:-3] == 0).all() and start[-3:].tolist() == [0, gas, 0]
    until_best = log["generations"][: log["best"]["generation"]]
    _, means = replay(space.first, CONFIG.evolution, log | {"generations": until_best})
    parameters, _ = load_controller(searched / "controller.safetensors")
    expected = space.expand(averaged_mean(means, CONFIG.evolution))
    assert np.array_equal(parameters, expected) and np.ptp(parameters) > 0
    assert {len(mean) for mean in means} == {18}


def test_components_are_fitted_once_and_belong_to_their_v_and_m(
    searched, quick_run, dataset, tmp_path
):
    assert not find_components(CONFIG, dataset, searched)
    assert not find_components(QUICK, dataset, quick_run)
    assert not (quick_run / COMPONENTS_FILE).exists()
    other = shutil.copytree(searched, tmp_path / "other")
    (other / COMPONENTS_FILE).unlink()
    with pytest.raises(FileNotFoundError, match=r"components\.safetensors"):
        search_space(CONFIG, load_world_model(other), other)
    assert find_components(CONFIG, dataset, other)
    assert (other / COMPONENTS_FILE).read_bytes() == (searched / COMPONENTS_FILE).read_bytes()


def test_components_are_fitted_on_one_thread_of_blas_whatever_the_machine_has(
    searched, dataset, tmp_path, monkeypatch
):
    threads = []

    def note(*arguments):
        threads.extend(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")
        return principal_components(*arguments)

    monkeypatch.setattr(subspace, "principal_components", note)
    folder = shutil.copytree(searched, tmp_path / "run")
    (folder / COMPONENTS_FILE).unlink()
    with threadpool_limits(2, user_api="blas"):
        assert find_components(CONFIG, dataset, folder)
    assert threads and set(threads) == {1}


def test_a_file_with_the_name_of_another_kind_is_refused(searched, tmp_path):
    folder, world_model = shutil.copytree(searched, tmp_path / "run"), load_world_model(searched)
    shutil.copy(folder / COMPONENTS_FILE, folder / START_FILE)
    with pytest.raises(ValueError, match="holds 'components': expected a file of 'start'"):
        search_space(CONFIG, world_model, folder)
    (folder / START_FILE).unlink()
    shutil.copy(folder / "mdn_rnn.safetensors", folder / COMPONENTS_FILE)
    with pytest.raises(ValueError, match="holds 'mdn_rnn': expected a file of 'components'"):
        search_space(CONFIG, world_model, folder)


def test_a_run_does_not_continue_along_other_components(searched, tmp_path):
    folder, other = (shutil.copytree(searched, tmp_path / name) for name in ("run", "other"))
    (other / COMPONENTS_FILE).unlink()
    # The components of another dataset, for the same V and M.
    with ThreadPoolExecutor(1) as executor:
        collect(QUICK.replace(data={"episodes": 4}), tmp_path / "dataset", executor)
    assert find_components(CONFIG, lambda: Dataset(tmp_path / "dataset"), other)
    shutil.copy(other / COMPONENTS_FILE, folder)
    before = (folder / LOG).read_bytes()
    with pytest.raises(ValueError, match="holds other components, or another first C"):
        evolve(CONFIG.replace(evolution={"generations": 6}), folder)
    assert (folder / LOG).read_bytes() == before
    assert verify(folder)["log of CMA-ES"].startswith("FAILED")


def test_a_run_along_components_can_be_verified_shipped_and_verified_again(
    searched, tmp_path, monkeypatch
):
    monkeypatch.setattr("stad_study.ship.PRETRAINED", tmp_path)
    for folder in (searched, ship(searched, "searched")):
        found = verify(folder)
        assert found["log of CMA-ES"] == "ok: 4 generations give the same mean", found
        assert not any(outcome.startswith("FAILED") for outcome in found.values()), found


def test_a_run_along_components_begins_at_the_start_too(tmp_path):
    checksums = {"vae": "v", "mdn_rnn": "m"}
    world_model = WorldModel(VAE("input", 4, 4), MDNRNN(4, 8, 3), 4, True, checksums)
    start = np.arange(39.0)
    save_start(tmp_path / START_FILE, start, "input", world_model)
    parts = {"middle": torch.ones(12).double(), "components": torch.eye(12).double()[:5]}
    save_tensors(tmp_path / COMPONENTS_FILE, parts, kind="components", **checksums)
    for components in (5, 0):
        config = QUICK.replace(evolution={"components": components})
        space = search_space(config, world_model, tmp_path)
        assert np.array_equal(space.expand(space.first), start)
