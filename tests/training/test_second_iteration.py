"""A second round: both drivers' episodes, C carried over to another V and M, and one budget for all of it."""

import dataclasses
import itertools
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from safetensors.numpy import load_file

from stad_lab.agent import load_agent, load_controller, read_world_model, save_controller
from stad_lab.config import Settings
from stad_lab.envs.car_racing import make_env
from stad_lab.envs.frames import to_frame
from stad_lab.evaluation.verify import verify
from stad_lab.io.files import load_json, save_json
from stad_lab.training.dataset import TRACK_RANGES, Rollouts, drive_randomly, track_seeds
from stad_lab.training.evolution import LOG
from stad_lab.training.pipeline import ship, total_budget, train
from stad_lab.training.second_iteration import (
    carry_over,
    collect_again,
    drive_noisily,
    fit_controller,
    order_of_episodes,
    outputs,
)
from stad_lab.training.subspace import features, load_start

VARIANT = "input_output"
SETTINGS = Settings.preset("quick", agent_episodes=3, processes=1)


@pytest.fixture(scope="module")
def second(quick_run, tmp_path_factory, noted_tracks):
    """The folder of a second round after the quick run; the tracks that were driven for it are in `tracks.json`."""
    folder = tmp_path_factory.mktemp("second") / "run"
    with noted_tracks() as tracks, ThreadPoolExecutor(1) as executor:
        assert train(VARIANT, SETTINGS, folder, executor=executor, earlier=quick_run)
    save_json(folder.parent / "tracks.json", {"tracks": tracks})
    return folder


def test_no_track_of_the_tests_or_for_inspection_is_driven_for_a_run(second):
    tracks = load_json(second.parent / "tracks.json")["tracks"]
    driven = {
        use: [track for track in tracks if low <= track < high]
        for use, (low, high) in TRACK_RANGES.items()
    }
    assert driven["test"] == driven["inspect"] == [] and sum(map(len, driven.values())) == len(
        tracks
    )
    assert len(driven["collect"]) == SETTINGS.episodes + SETTINGS.agent_episodes
    assert len(driven["evolve"]) == SETTINGS.generations * SETTINGS.population
    assert set(driven["validate"]) == set(track_seeds("validate", SETTINGS.validation_tracks))


def test_the_dataset_holds_the_episodes_of_both_drivers(second, quick_run, agent):
    order, rollouts = order_of_episodes(SETTINGS), Rollouts(second / "rollouts")
    assert sorted(order) == list(range(11)) and len(rollouts.frames) == 11
    for block, number in enumerate(order):
        if number < SETTINGS.episodes:
            assert np.array_equal(rollouts.frames[block], drive_randomly(SETTINGS, number)[0])
        else:
            frames, actions, track = drive_noisily(agent, SETTINGS, number - SETTINGS.episodes)
            assert np.array_equal(rollouts.frames[block], frames)
            assert np.array_equal(rollouts.actions[block], actions)
            assert rollouts.manifest["blocks"][block]["track"] == track
    assert order[-1] != 10  # mixed


def test_a_collection_of_both_drivers_goes_on_where_it_stopped(second, quick_run, tmp_path):
    folder = shutil.copytree(second / "rollouts", tmp_path / "rollouts")
    manifest = load_json(folder / "manifest.json")
    save_json(folder / "manifest.json", manifest | {"blocks": manifest["blocks"][2:7]})
    assert collect_again(VARIANT, SETTINGS, quick_run, folder)
    assert not collect_again(VARIANT, SETTINGS, quick_run, folder)
    assert load_json(folder / "manifest.json") == manifest


def test_a_second_round_asks_for_the_room_that_its_two_kinds_of_episodes_may_take(
    quick_run, tmp_path, monkeypatch
):
    settings = dataclasses.replace(SETTINGS, agent_episodes=1000, max_frames=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=0))
    with pytest.raises(OSError, match=r"up to \d+\.\d\d GB") as error:
        collect_again(VARIANT, settings, quick_run, tmp_path)
    asked = float(re.search(r"up to (\d+\.\d+) GB", str(error.value))[1])
    frames = (
        settings.agent_episodes * settings.max_frames + settings.episodes * settings.episode_frames
    )
    assert asked == pytest.approx(frames * (64 * 64 * 3 + 12) / 1e9, rel=1e-3)


def test_a_second_round_that_would_see_the_bar_otherwise_is_refused_before_any_work(
    quick_run, tmp_path
):
    other = dataclasses.replace(SETTINGS, crop_bar=not SETTINGS.crop_bar)
    with pytest.raises(
        ValueError,
        match=f"crop_bar={other.crop_bar}, but the run in .*={SETTINGS.crop_bar}: set that",
    ):
        train(VARIANT, other, tmp_path / "run", earlier=quick_run)
    assert not (tmp_path / "run").exists()


def test_a_first_round_whose_c_is_of_another_m_is_refused_before_any_work(quick_run, tmp_path):
    folder = shutil.copytree(
        quick_run, tmp_path / "mixed", ignore=shutil.ignore_patterns("rollouts")
    )
    parameters, facts = load_controller(folder / "controller.safetensors", VARIANT)
    strange = {"variant": VARIANT, "autoencoder": facts["autoencoder"], "mdn_rnn": "another"}
    save_controller(folder / "controller.safetensors", parameters, **strange)
    with pytest.raises(ValueError, match="was made with another mdn_rnn than the one beside it"):
        train(VARIANT, SETTINGS, tmp_path / "run", earlier=folder)
    assert not (tmp_path / "run").exists()


def test_a_first_round_that_is_not_at_its_end_is_refused_before_any_work(quick_run, tmp_path):
    folder = shutil.copytree(
        quick_run, tmp_path / "half", ignore=shutil.ignore_patterns("rollouts")
    )
    log = load_json(folder / LOG)
    save_json(folder / LOG, log | {"generations": log["generations"][:2]})
    with pytest.raises(
        ValueError,
        match=r"is not at its end, with 2 of 4 generations: run its own command to the end",
    ):
        train(VARIANT, SETTINGS, tmp_path / "run", earlier=folder)
    assert not (tmp_path / "run").exists()


def test_a_second_round_goes_on_only_from_the_first_as_it_was(second, quick_run, tmp_path):
    other = shutil.copytree(
        quick_run, tmp_path / "other", ignore=shutil.ignore_patterns("rollouts")
    )
    record = load_json(other / "record.json")
    save_json(
        other / "record.json", record | {"seconds": {}, "peak_memory": {}}
    )  # it was looked at again
    assert not train(VARIANT, SETTINGS, second, earlier=other)
    save_json(
        other / "record.json",
        record | {"budget": record["budget"] | {"random": {"episodes": 9, "frames": 9}}},
    )
    with pytest.raises(
        ValueError, match="holds a run that does not go on from the one given as it is now"
    ):
        train(VARIANT, SETTINGS, second, earlier=other)


def test_an_unsteady_hand_differs_between_episodes_and_m_remembers_what_was_done(agent, quick_run):
    frames, actions, _ = drive_noisily(agent, SETTINGS, 0)
    seen = features(read_world_model(quick_run, VARIANT), frames, actions)[-1]
    assert np.concatenate([agent.latents[0], agent.hidden[0]]) == pytest.approx(seen, abs=1e-3)
    steady = features(read_world_model(quick_run, VARIANT), frames, 0 * actions)[-1]
    assert np.abs(steady - seen).max() > 0.01
    assert np.array_equal(drive_noisily(agent, SETTINGS, 0)[1], actions)
    assert not np.array_equal(drive_noisily(agent, SETTINGS, 1)[1], actions)
    assert (actions >= [-1, 0, 0]).all() and (actions <= 1).all()


def test_an_unsteady_hand_wanders_and_every_episode_s_by_another_size(agent):
    sizes = []
    for episode in range(3):
        frames, actions, track = drive_noisily(agent, SETTINGS, episode)
        env, noise = make_env(fast=True), []
        observation, _ = env.reset(seed=track)
        agent.reset()
        for frame, action in zip(frames, actions, strict=True):
            assert np.array_equal(frame, to_frame(observation, SETTINGS.crop_bar))
            before, meant = agent.state, agent.act(observation)
            agent.take_in(action[None], before)
            noise.append(action[0] - meant[0])
            observation, *_ = env.step(action)
        env.close()
        sizes.append(np.std(noise))
        assert np.corrcoef(noise[1:], noise[:-1])[0, 1] > 0.5
    assert min(sizes) > 1e-3 and max(sizes) > 1.5 * min(sizes)


def test_evolution_starts_from_what_the_earlier_agent_knew(second, quick_run):
    old, new = (read_world_model(folder, VARIANT) for folder in (quick_run, second))
    start = load_start(second / "start.safetensors", new)
    parameters, _ = load_controller(quick_run / "controller.safetensors", VARIANT)
    rollouts, agreed, spread = Rollouts(second / "rollouts"), [], []
    for block, number in enumerate(order_of_episodes(SETTINGS)):
        if number >= SETTINGS.episodes:
            drive = rollouts.frames[block], rollouts.actions[block]
            wanted, found = (
                outputs(parameters, features(old, *drive)),
                outputs(start, features(new, *drive)),
            )
            agreed.append(((wanted - found) ** 2).sum(axis=0))
            spread.append(((wanted - wanted.mean(axis=0)) ** 2).sum(axis=0))
    assert (np.sum(agreed, axis=0) < np.sum(spread, axis=0)).all()
    assert not np.array_equal(start, parameters)


def test_a_controller_is_found_again_from_its_own_outputs():
    rng = np.random.default_rng(0)
    parameters, seen = rng.standard_normal(3 * 20 + 3), 30 * rng.standard_normal((500, 20))
    everything = np.ones(20, bool)
    assert fit_controller(seen, outputs(parameters, seen), everything) == pytest.approx(
        parameters, abs=1e-2
    )


def test_a_controller_that_may_not_see_a_feature_has_no_weight_for_it():
    rng = np.random.default_rng(0)
    seen, wanted, columns = (
        rng.standard_normal((500, 20)),
        rng.standard_normal((500, 3)),
        np.arange(20) < 8,
    )
    found = fit_controller(seen, wanted, columns)
    alone = fit_controller(seen[:, columns], wanted, np.ones(8, bool))
    assert np.array_equal(found[:-3].reshape(3, 20)[:, ~columns], np.zeros((3, 12)))
    assert outputs(found, seen) == pytest.approx(outputs(alone, seen[:, columns]))


def test_a_second_round_on_z_alone_starts_without_weights_for_h(second, quick_run, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for part in ("autoencoder", "mdn_rnn"):
        shutil.copy(second / f"{part}.safetensors", folder)
    settings = dataclasses.replace(SETTINGS, features="z")
    carry_over(VARIANT, settings, quick_run, second / "rollouts", folder)
    start = load_file(folder / "start.safetensors")["parameters"]
    weights = start[:-3].reshape(3, -1)
    assert not weights[:, SETTINGS.latent_size :].any() and weights[:, : SETTINGS.latent_size].all()


def test_both_rounds_are_in_the_budget(second, quick_run):
    record, first = load_json(second / "record.json"), load_json(quick_run / "record.json")
    assert record["earlier"]["budget"] == first["budget"]
    assert (
        record["budget"]["random"]["episodes"] == 8
        and record["budget"]["agent_driver"]["episodes"] == 3
    )
    mine, before, both = record["budget"], total_budget(first), total_budget(record)
    frames = sum(
        mine[part]["frames"] for part in ("agent_driver", "evolution", "validation")
    )  # the others are the same
    assert both["frames"] == frames + before["frames"]
    assert both["agents"] == 2 * before["agents"] == 32
    assert both["episodes"] == before["episodes"] + 3 + 16 + 4


def test_a_finished_second_round_is_verified_and_left_alone(second, quick_run):
    assert not train(VARIANT, SETTINGS, second, earlier=quick_run)
    assert not any(outcome.startswith("FAILED") for outcome in verify(second).values())


def test_a_shipped_second_round_lies_beside_the_first_and_can_be_verified(
    second, quick_run, tmp_path
):
    assert ship(VARIANT, quick_run, tmp_path) == tmp_path / VARIANT
    shipped = ship(VARIANT, second, tmp_path)
    assert shipped == tmp_path / "second_round" / VARIANT
    assert load_agent(VARIANT, shipped).parameters.size == 3 * 56 + 3
    found = verify(shipped)
    assert found["log of CMA-ES"] == "ok: 4 generations lead to the same mean" and found[
        "C"
    ].startswith("ok")


def test_an_evolution_without_its_start_is_refused_and_the_command_makes_it_again(
    second, quick_run, tmp_path
):
    folder = shutil.copytree(second, tmp_path / "run")
    before = load_file(folder / "start.safetensors")
    (folder / "start.safetensors").write_bytes(b"cut")
    with pytest.raises(
        ValueError,
        match=r"start.safetensors is damaged.*delete it and run the command that made this run again",
    ) as error:
        train(VARIANT, SETTINGS, folder, earlier=quick_run)
    assert str(error.value).count("delete it") == 1
    (folder / "start.safetensors").unlink()
    train(VARIANT, SETTINGS, folder, earlier=quick_run)
    assert np.array_equal(
        load_file(folder / "start.safetensors")["parameters"], before["parameters"]
    )


@pytest.mark.parametrize(("episodes", "earlier"), [(3, None), (0, "somewhere")])
def test_a_second_round_needs_both_an_earlier_run_and_episodes(episodes, earlier, tmp_path):
    with pytest.raises(
        ValueError,
        match=f"agent_episodes={episodes} and earlier={earlier}: a second round needs both",
    ):
        train(
            VARIANT,
            Settings.preset("quick", agent_episodes=episodes),
            tmp_path / "run",
            earlier=earlier,
        )
    assert not (tmp_path / "run").exists()


def test_an_unsteady_hand_is_given_up_when_it_reaches_no_new_tile_and_not_before(agent):
    settings = Settings.preset("quick", agent_episodes=3)
    both = [dataclasses.replace(settings, patience=patience) for patience in (13, 0)]
    given_up, (_, actions, track) = (drive_noisily(agent, chosen, 0) for chosen in both)
    env = make_env()
    env.reset(seed=track)
    reached = [t for t, action in enumerate(actions, 1) if env.step(action)[1] > 0]
    env.close()
    last = next(t for t, following in itertools.pairwise([0, *reached, 1000]) if following - t > 13)
    assert len(given_up[0]) == min(60, last + 13) > 13


def test_random_episodes_count_once_only_if_they_are_those_of_the_first_round():
    driven, settings = {"episodes": 8, "frames": 480}, Settings.preset("quick").as_dict()
    first = {"settings": settings, "budget": {"random": driven, "agents": 16}}
    for seed, episodes in ((0, 8), (1, 16)):
        record = {
            "settings": settings | {"seed": seed},
            "budget": {"random": driven},
            "earlier": first,
        }
        assert total_budget(record) == {"episodes": episodes, "frames": 60 * episodes, "agents": 16}


def test_the_drives_of_another_agent_are_another_dataset(quick_run, tmp_path, monkeypatch):
    made, settings = [], Settings.preset("quick", agent_episodes=3)
    monkeypatch.setattr(
        "stad_lab.training.second_iteration.collect",
        lambda folder, made_with, *rest: made.append(made_with),
    )
    other = shutil.copytree(
        quick_run, tmp_path / "other", ignore=shutil.ignore_patterns("rollouts")
    )
    parameters, _ = load_controller(other / "controller.safetensors", "input_output")
    save_controller(other / "controller.safetensors", parameters + 1, variant="input_output")
    for earlier in (quick_run, quick_run, other):
        collect_again("input_output", settings, earlier, tmp_path, object())
    assert made[0] == made[1] != made[2]


def test_the_penalty_of_the_regression_is_for_each_frame():
    rng, columns = np.random.default_rng(0), np.ones(20, bool)
    seen, wanted = rng.standard_normal((100, 20)), rng.standard_normal((100, 3))
    once, often = (
        fit_controller(np.tile(seen, (n, 1)), np.tile(wanted, (n, 1)), columns) for n in (1, 50)
    )
    assert often == pytest.approx(once, rel=1e-6)
