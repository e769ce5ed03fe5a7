"""A second iteration: episodes of both drivers, C carried over to a new V and M, one budget."""

import itertools
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from safetensors.numpy import load_file

from stad_lab.agent import load_agent
from stad_lab.config import TRACK_RANGES, Config, track_seeds
from stad_lab.envs.cars import Cars
from stad_lab.evaluation.verify import verify
from stad_lab.features import features_of
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import load_controller, load_world_model, save_controller
from stad_lab.training import second_iteration
from stad_lab.training.dataset import Dataset, collect, drive_randomly
from stad_lab.training.evolution import LOG
from stad_lab.training.pipeline import train
from stad_lab.training.record import total_budget
from stad_lab.training.second_iteration import (
    carry_over,
    collect_again,
    drive_noisily,
    fit_controller,
    order_of_episodes,
    outputs,
)
from stad_lab.training.subspace import START_FILE, load_start
from stad_study.ship import ship

QUICK = Config.preset("quick")
BRIEF = {"vae": {"steps": 8}, "mdn_rnn": {"steps": 4}}
CONFIG = QUICK.replace(data={"agent_episodes": 3}, processes=1, **BRIEF)
C = "controller.safetensors"


def copy_run(run, folder):
    return shutil.copytree(run, folder, ignore=shutil.ignore_patterns("dataset"))


@pytest.fixture(scope="module")
def second(quick_run, tmp_path_factory, noted_tracks):
    """The folder of a second iteration of the quick run; its tracks are in `tracks.json`."""
    folder = tmp_path_factory.mktemp("second") / "run"
    with noted_tracks() as tracks, ThreadPoolExecutor(1) as executor:
        assert train(CONFIG, folder, executor=executor, earlier=quick_run)
    save_json(folder.parent / "tracks.json", {"tracks": tracks})
    return folder


@pytest.fixture(scope="module")
def dataset(second):
    """The dataset of the second iteration."""
    return Dataset(second / "dataset")


def test_no_track_for_tests_or_inspection_is_driven_for_a_run(second):
    tracks = load_json(second.parent / "tracks.json")["tracks"]
    driven = {
        use: [track for track in tracks if low <= track < high]
        for use, (low, high) in TRACK_RANGES.items()
    }
    assert driven["test"] == driven["inspect"] == []
    assert sum(map(len, driven.values())) == len(tracks)
    assert len(driven["collect"]) == CONFIG.data.episodes + CONFIG.data.agent_episodes
    evolution = CONFIG.evolution
    assert len(driven["evolve"]) == evolution.generations * evolution.population
    assert set(driven["validate"]) == set(track_seeds("validate", evolution.validation_tracks))


def test_the_dataset_has_the_episodes_of_both_drivers_in_mixed_order(dataset, agent):
    order, first = order_of_episodes(CONFIG), CONFIG.data.episodes
    assert sorted(order) == list(range(11)) and len(dataset.frames) == 11 and order[-1] != 10
    for entry, number in enumerate(order):
        random = number < first
        driven = (
            drive_randomly(CONFIG, number)
            if random
            else drive_noisily(agent, CONFIG, number - first)
        )
        assert np.array_equal(dataset.frames[entry], driven[0])
        assert np.array_equal(dataset.actions[entry], driven[1])
        assert dataset.manifest["episodes"][entry]["track"] == driven[2]


def test_an_interrupted_collection_of_both_drivers_continues(second, quick_run, tmp_path):
    folder = shutil.copytree(second / "dataset", tmp_path / "dataset")
    manifest = load_json(folder / "manifest.json")
    save_json(folder / "manifest.json", manifest | {"episodes": manifest["episodes"][2:7]})
    with ThreadPoolExecutor(1) as executor:
        assert collect_again(CONFIG, quick_run, folder, executor)
        assert not collect_again(CONFIG, quick_run, folder, executor)
    assert load_json(folder / "manifest.json") == manifest


def test_the_dataset_of_one_iteration_is_not_taken_for_that_of_the_other(
    second, quick_run, tmp_path
):
    first = shutil.copytree(quick_run / "dataset", tmp_path / "dataset")
    with ThreadPoolExecutor(1) as executor:
        with pytest.raises(ValueError, match=r"data.agent_episodes=0, now data.agent_episodes=3"):
            collect_again(CONFIG, quick_run, first, executor)
        with pytest.raises(ValueError, match=r"data.agent_episodes=3, now data.agent_episodes=0"):
            collect(QUICK, second / "dataset", executor)


def test_the_space_on_the_disk_is_that_of_both_kinds_of_episodes(quick_run, tmp_path, monkeypatch):
    config = CONFIG.replace(data={"agent_episodes": 1000, "agent_frames": 1000})
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=0))
    with ThreadPoolExecutor(1) as executor, pytest.raises(OSError, match="up to") as error:
        collect_again(config, quick_run, tmp_path, executor)
    asked = float(re.search(r"up to (\d+\.\d\d) GB", str(error.value))[1])
    frames = 1000 * 1000 + config.data.episodes * config.data.episode_frames
    assert asked == pytest.approx(frames * (64 * 64 * 3 + 12) / 1e9, rel=1e-3)


def of_another_m(folder):
    parameters, metadata = load_controller(folder / C)
    other = {"variant": "input_output", "vae": metadata["vae"], "mdn_rnn": "another"}
    save_controller(folder / C, parameters, **other)


def unfinished(folder):
    log = load_json(folder / LOG)
    save_json(folder / LOG, log | {"generations": log["generations"][:2]})


def without_budget(folder):
    record = load_json(folder / "record.json")
    del record["budget"]
    save_json(folder / "record.json", record)


@pytest.mark.parametrize(
    ("change", "config", "error"),
    [
        (
            None,
            CONFIG.replace(data={"crop_bar": False}),
            "data.crop_bar=False, but the run in .* ha",
        ),
        (
            None,
            CONFIG.replace(variant="frame"),
            "variant='frame', but the run in .* 'input_output'",
        ),
        (of_another_m, CONFIG, "was made with another mdn_rnn than the one beside it"),
        (
            unfinished,
            CONFIG,
            "is not finished, with 2 of 4 generations: run its own command to the",
        ),
        (without_budget, CONFIG, "is not finished, with 4 of 4 generations: run its own command"),
    ],
)
def test_an_earlier_run_that_does_not_fit_is_refused_before_any_work(
    change, config, error, quick_run, tmp_path
):
    earlier = copy_run(quick_run, tmp_path / "earlier")
    if change:
        change(earlier)
    with pytest.raises(ValueError, match=error):
        train(config, tmp_path / "run", earlier=earlier)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("episodes", "earlier"), [(3, None), (0, "somewhere")])
def test_a_second_iteration_needs_both_an_earlier_run_and_episodes(episodes, earlier, tmp_path):
    config = QUICK.replace(data={"agent_episodes": episodes})
    error = f"agent_episodes={episodes} and earlier={earlier}: a second iteration needs both"
    with pytest.raises(ValueError, match=error):
        train(config, tmp_path / "run", earlier=earlier)
    assert not (tmp_path / "run").exists()


def test_a_second_iteration_continues_only_with_the_agent_that_it_began_with(
    second, quick_run, tmp_path
):
    other = copy_run(quick_run, tmp_path / "other")
    record = load_json(other / "record.json")
    save_json(other / "record.json", record | {"seconds": {}})
    assert not train(CONFIG, second, earlier=other)  # the same run in another place
    parameters, metadata = load_controller(other / C)
    del metadata["kind"]
    save_controller(other / C, parameters + 1, **metadata)
    with pytest.raises(ValueError, match=r"was made with agent.controller="):
        train(CONFIG, second, earlier=other)


def test_a_second_iteration_into_a_run_of_a_first_one_is_refused_before_it_drives(
    quick_run, tmp_path
):
    folder = copy_run(quick_run, tmp_path / "run")  # as one that shares another's dataset
    with pytest.raises(ValueError, match=r"data.agent_episodes=0, now data.agent_episodes=3"):
        train(QUICK.replace(data={"agent_episodes": 3}, processes=1), folder, earlier=quick_run)
    assert not (folder / "dataset").exists()


def test_the_episodes_of_another_agent_are_another_dataset(quick_run, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(second_iteration, "collect_episodes", lambda *given: made.append(given[1]))
    other = copy_run(quick_run, tmp_path / "other")
    parameters, _ = load_controller(other / C)
    save_controller(other / C, parameters + 1, variant="input_output", vae="", mdn_rnn="")
    for earlier in (quick_run, quick_run, other):
        collect_again(CONFIG, earlier, tmp_path, object())
    assert made[0] == made[1] != made[2]


# The noisy driver


def test_noise_differs_between_episodes_and_m_remembers_the_disturbed_actions(agent, quick_run):
    world_model = load_world_model(quick_run)
    frames, actions, _ = drive_noisily(agent, CONFIG, 0)
    seen = features_of(world_model, frames, actions)[-1]
    assert np.concatenate([agent.latents[0], agent.hidden[0]]) == pytest.approx(seen, abs=1e-3)
    without = features_of(world_model, frames, 0 * actions)[-1]
    assert np.abs(without - seen).max() > 0.01
    assert np.array_equal(drive_noisily(agent, CONFIG, 0)[1], actions)
    assert not np.array_equal(drive_noisily(agent, CONFIG, 1)[1], actions)
    assert (actions >= [-1, 0, 0]).all() and (actions <= 1).all()


def test_noise_is_correlated_in_time_and_its_strength_differs_between_episodes(agent):
    strengths = []
    for episode in range(3):
        frames, actions, track = drive_noisily(agent, CONFIG, episode)
        cars, noise = Cars(1, "frame", bar=not CONFIG.data.crop_bar), []
        cars.reset([track])
        agent.reset()
        for frame, action in zip(frames, actions, strict=True):
            assert np.array_equal(frame, cars.draw()[0])
            before, meant = agent.state, agent.act_batch(frame[None])[0]
            agent.remember(action[None], before)
            noise.append(action[0] - meant[0])
            cars.step(action[None])
        strengths.append(np.std(noise))
        assert np.corrcoef(noise[1:], noise[:-1])[0, 1] > 0.5
    assert min(strengths) > 1e-3 and max(strengths) > 1.5 * min(strengths)


def test_a_noisy_episode_ends_after_the_patience_without_a_new_tile(agent):
    impatient = CONFIG.replace(data={"agent_patience": 13})
    patient = CONFIG.replace(data={"agent_patience": 0})
    ended, (_, actions, track) = (drive_noisily(agent, one, 0) for one in (impatient, patient))
    cars = Cars(1)
    cars.reset([track])
    reached = [t for t, action in enumerate(actions, 1) if cars.step(action[None])[0] > 0]
    last = next(t for t, following in itertools.pairwise([0, *reached, 1000]) if following - t > 13)
    assert len(ended[0]) == min(60, last + 13) > 13


# C, carried over


def test_evolution_starts_from_a_c_with_the_outputs_of_the_earlier_one(second, quick_run, dataset):
    old, new = load_world_model(quick_run), load_world_model(second)
    start = load_start(second / START_FILE, new)
    parameters, _ = load_controller(quick_run / C)
    errors, spread = [], []
    for entry, number in enumerate(order_of_episodes(CONFIG)):
        if number >= CONFIG.data.episodes:
            episode = dataset.frames[entry], dataset.actions[entry]
            wanted = outputs(parameters, features_of(old, *episode))
            found = outputs(start, features_of(new, *episode))
            errors.append(((wanted - found) ** 2).sum(axis=0))
            spread.append(((wanted - wanted.mean(axis=0)) ** 2).sum(axis=0))
    assert (np.sum(errors, axis=0) < np.sum(spread, axis=0)).all()
    assert not np.array_equal(start, parameters)


def test_a_controller_is_found_again_from_its_own_outputs():
    rng = np.random.default_rng(0)
    parameters, seen = rng.standard_normal(3 * 20 + 3), 30 * rng.standard_normal((500, 20))
    found = fit_controller(seen, outputs(parameters, seen), np.ones(20, bool))
    assert found == pytest.approx(parameters, abs=1e-2)


def test_a_controller_has_no_weight_for_a_feature_that_it_may_not_see():
    rng, columns = np.random.default_rng(0), np.arange(20) < 8
    seen, wanted = rng.standard_normal((500, 20)), rng.standard_normal((500, 3))
    found = fit_controller(seen, wanted, columns)
    alone = fit_controller(seen[:, columns], wanted, np.ones(8, bool))
    assert np.array_equal(found[:-3].reshape(3, 20)[:, ~columns], np.zeros((3, 12)))
    assert outputs(found, seen) == pytest.approx(outputs(alone, seen[:, columns]))


def test_the_penalty_of_the_regression_is_for_each_frame():
    rng, columns = np.random.default_rng(0), np.ones(20, bool)
    seen, wanted = rng.standard_normal((100, 20)), rng.standard_normal((100, 3))
    once, often = (
        fit_controller(np.tile(seen, (n, 1)), np.tile(wanted, (n, 1)), columns) for n in (1, 50)
    )
    assert often == pytest.approx(once, rel=1e-6)


def test_a_c_that_sees_z_alone_starts_without_weights_for_h(second, quick_run, dataset, tmp_path):
    for part in ("vae", "mdn_rnn"):
        shutil.copy(second / f"{part}.safetensors", tmp_path)
    config = CONFIG.replace(evolution={"features": "z"})
    assert carry_over(config, quick_run, lambda: dataset, tmp_path)
    weights = load_file(tmp_path / START_FILE)["parameters"][:-3].reshape(3, -1)
    assert not weights[:, 32:].any() and weights[:, :32].all()
    assert not carry_over(config, quick_run, lambda: dataset, tmp_path)
    assert carry_over(CONFIG, quick_run, lambda: dataset, tmp_path)  # other features: fitted anew
    assert load_file(tmp_path / START_FILE)["parameters"][:-3].reshape(3, -1)[:, 32:].any()


def test_a_damaged_start_is_refused_and_a_missing_one_is_made_again(second, quick_run, tmp_path):
    folder = shutil.copytree(second, tmp_path / "run")
    before = load_file(folder / START_FILE)
    (folder / START_FILE).write_bytes(b"cut")
    with pytest.raises(ValueError, match=r"start.safetensors is damaged.*delete it and") as error:
        train(CONFIG, folder, earlier=quick_run)
    assert str(error.value).count("delete it") == 1
    (folder / START_FILE).unlink()
    train(CONFIG, folder, earlier=quick_run)
    assert np.array_equal(load_file(folder / START_FILE)["parameters"], before["parameters"])


# The finished run


def test_both_iterations_are_in_the_budget(second, quick_run):
    record, first = load_json(second / "record.json"), load_json(quick_run / "record.json")
    own, before, both = record["budget"], total_budget(first), total_budget(record)
    assert record["earlier"]["budget"] == first["budget"]
    assert own["random"]["episodes"] == 8 and own["agent_driver"]["episodes"] == 3
    new = sum(own[part]["frames"] for part in ("agent_driver", "evolution", "validation"))
    assert both["frames"] == new + before["frames"]
    assert both["agents"] == 2 * before["agents"] == 32
    assert both["episodes"] == before["episodes"] + 3 + 16 + 4


def test_random_episodes_count_once_only_if_they_are_those_of_the_first_iteration():
    driven, config = {"episodes": 8, "frames": 480}, QUICK.as_dict()
    first = {"config": config, "budget": {"random": driven, "agents": 16}}
    for seed, episodes in ((0, 8), (1, 16)):
        record = {"config": CONFIG.replace(seed=seed).as_dict(), "budget": {"random": driven}}
        found = total_budget(record | {"earlier": first})
        assert found == {"episodes": episodes, "frames": 60 * episodes, "agents": 16}


def test_a_finished_second_iteration_is_verified_shipped_and_left_alone(
    second, quick_run, tmp_path, monkeypatch
):
    assert not train(CONFIG, second, earlier=quick_run)
    monkeypatch.setattr("stad_study.ship.PRETRAINED", tmp_path)
    shipped = ship(second, "second")
    assert load_agent(shipped).parameters.size == 3 * 56 + 3
    for folder in (second, shipped):
        found = verify(folder)
        assert not any(outcome.startswith("FAILED") for outcome in found.values()), found
        assert found["log of CMA-ES"] == "ok: 4 generations give the same mean"
        assert found["C"].startswith("ok")
