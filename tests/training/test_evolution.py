"""CMA-ES over C: a log of every generation, and an interrupt that changes nothing."""

import itertools
import json
import os
import shutil
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from stad_lab.agent import PRETRAINED, drive
from stad_lab.cli import main
from stad_lab.config import TRACK_RANGES, Config, track_seeds
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import load_controller
from stad_lab.models.controller import initial_parameters
from stad_lab.training import evolution
from stad_lab.training.evolution import (
    LOG,
    ask,
    averaged_mean,
    crc,
    drive_generation,
    drive_parallel,
    evolve,
    fitness_curves,
    generation_tracks,
    make_agent,
    make_strategy,
    note_best,
    replay,
    tell,
    validate,
)

GENERATIONS = 6
RANDOM = {"entropy": 0, "spawn_key": [7, 0]}
C = "controller.safetensors"


def config(processes=2, seed=0, **changes):
    """That of the quick run, with more generations and with changes to the evolution."""
    changes = {"generations": GENERATIONS} | changes
    return Config.preset("quick", evolution=changes, processes=processes, seed=seed)


def settings(**changes):
    """The evolution part of `config`."""
    return config(**changes).evolution


def without_evolution(run, folder):
    """A copy of a run whose controller is not evolved yet."""
    return shutil.copytree(run, folder, ignore=shutil.ignore_patterns(LOG, C, "dataset"))


@pytest.fixture(scope="module")
def uninterrupted(quick_run, tmp_path_factory):
    """An evolution in one piece, in one process."""
    folder = without_evolution(quick_run, tmp_path_factory.mktemp("evolution") / "uninterrupted")
    assert evolve(config(processes=1), folder)
    return folder


@pytest.fixture(scope="module")
def first_part(quick_run, tmp_path_factory):
    """The first two generations, in two processes."""
    folder = without_evolution(quick_run, tmp_path_factory.mktemp("evolution") / "first_part")
    assert evolve(config(generations=2), folder)
    return folder


def assert_equal_evolutions(folder, other):
    """The logs and the controllers are bit-identical."""
    assert load_json(folder / LOG) == load_json(other / LOG)
    assert (folder / C).read_bytes() == (other / C).read_bytes()


def test_the_returns_are_the_same_for_one_and_two_processes(uninterrupted, first_part):
    first = load_json(first_part / LOG)["generations"]
    assert len(first) == 2 and first == load_json(uninterrupted / LOG)["generations"][:2]


def test_an_evolution_in_two_parts_equals_an_uninterrupted_one(uninterrupted, first_part, tmp_path):
    folder = shutil.copytree(first_part, tmp_path / "run")
    assert evolve(config(processes=1), folder)
    assert_equal_evolutions(folder, uninterrupted)


def test_an_evolution_may_continue_in_other_groups_of_cars_with_the_same_bits(
    uninterrupted, first_part, tmp_path
):
    folder = shutil.copytree(first_part, tmp_path / "run")
    assert evolve(config(processes=1, cars=1), folder)
    found, expected = (load_json(run / LOG) for run in (folder, uninterrupted))
    assert found["evolution"]["cars"] == 1 != expected["evolution"]["cars"]
    assert found["generations"] == expected["generations"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals to send to a process")
def test_an_interrupted_command_continues_and_equals_an_uninterrupted_one(
    uninterrupted, quick_run, tmp_path, capsys
):
    folder = shutil.copytree(quick_run, tmp_path / "run", ignore=shutil.ignore_patterns(LOG, C))
    command = ["train", "quick", "--variant", "input_output", "--out", str(folder)]
    command += ["--evolution.generations", str(GENERATIONS), "--processes", "1"]

    def press_ctrl_c():
        deadline = time.time() + 120
        while not (folder / LOG).exists() and time.time() < deadline:
            time.sleep(0.005)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with ThreadPoolExecutor(1) as finger:
            finger.submit(press_ctrl_c)
            assert main(command) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    error = capsys.readouterr().err
    assert "stopped; the same command continues from there" in error and "Traceback" not in error
    assert 1 <= len(load_json(folder / LOG)["generations"]) < GENERATIONS  # it was in the middle
    assert main(command) == 0
    assert_equal_evolutions(folder, uninterrupted)


def test_an_evolution_that_is_stopped_while_it_is_watched_continues_to_the_same_log(
    uninterrupted, quick_run, tmp_path
):
    folder, seen = without_evolution(quick_run, tmp_path / "run"), []

    def watch(generations):
        seen.append(len(generations))
        if seen == [1, 2]:
            raise KeyboardInterrupt

    def again():
        return evolve(config(processes=1), folder, watch=watch)

    with pytest.raises(KeyboardInterrupt):
        again()
    assert again()
    assert not again()  # shown, not repeated
    assert seen == [1, 2, *range(2, GENERATIONS + 1), GENERATIONS]
    assert_equal_evolutions(folder, uninterrupted)


def test_a_complete_evolution_is_left_alone(uninterrupted):
    before = {path: path.stat().st_mtime_ns for path in uninterrupted.iterdir()}
    assert not evolve(config(processes=1), uninterrupted)
    assert {path: path.stat().st_mtime_ns for path in uninterrupted.iterdir()} == before


def test_every_generation_is_logged_on_new_tracks_of_the_range_for_evolution(uninterrupted):
    generations = load_json(uninterrupted / LOG)["generations"]
    assert [entry["generation"] for entry in generations] == list(range(1, GENERATIONS + 1))
    low, high = TRACK_RANGES["evolve"]
    tracks = [track for entry in generations for track in entry["tracks"]]
    assert all(low <= track < high for track in tracks) and len(set(tracks)) == GENERATIONS
    for entry in generations:
        assert len(entry["returns"]) == settings().population
        assert 0 < entry["frames"] <= 60 * settings().population
    curves = fitness_curves(generations)
    assert curves.shape == (3, GENERATIONS) and (curves[0] < curves[2]).any()


def test_worst_mean_and_best_are_of_the_mean_returns_of_the_agents():
    generations = [{"returns": [[1, 3], [10, 20], [-5, 5]]}, {"returns": [[7, 7], [9, 7], [8, 8]]}]
    assert fitness_curves(generations).tolist() == [[0, 7], [17 / 3, 23 / 3], [15, 8]]


def test_the_controller_is_the_averaged_mean_with_the_best_validation(uninterrupted):
    log = load_json(uninterrupted / LOG)
    validations = {
        entry["generation"]: entry["validation"]["mean"]
        for entry in log["generations"]
        if "validation" in entry
    }
    assert list(validations) == [2, 4, 6]
    best = max(validations, key=validations.get)
    assert log["best"] == {"generation": best, "validation": validations[best]}
    start = initial_parameters(32, 24, settings().initial_gas)
    _, means = replay(start, settings(), log | {"generations": log["generations"][:best]})
    expected = averaged_mean(means, settings())
    assert np.array_equal(load_controller(uninterrupted / C)[0], expected)


def test_the_first_of_two_equally_good_validations_is_kept():
    log = {"generations": [{"generation": 2, "validation": {"mean": 5.0}}], "best": None}
    assert note_best(log)
    log["generations"].append({"generation": 4, "validation": {"mean": 5.0}})
    assert not note_best(log) and log["best"] == {"generation": 2, "validation": 5.0}


def test_an_agent_s_returns_are_those_of_its_own_episodes_on_the_tracks(quick_run):
    several = config(tracks=2, max_frames=90)
    population = np.array([initial_parameters(32, 24, gas=gas) for gas in (-3.0, -0.5, 0.5)])
    with ThreadPoolExecutor(1) as executor:
        entry = drive_generation(executor, quick_run, several, [], population)
    for parameters, returns in zip(population, entry["returns"], strict=True):
        agent = make_agent(quick_run, parameters)
        alone = [drive(agent, [track], max_frames=90).returns[0] for track in entry["tracks"]]
        assert returns == pytest.approx(alone, abs=1e-3)
    assert len({tuple(returns) for returns in entry["returns"]}) == 3


def test_patience_ends_an_episode_in_a_generation_and_not_in_a_validation(quick_run):
    impatient, braking = config(patience=25, max_frames=80), initial_parameters(32, 24, gas=-9.0)
    with ThreadPoolExecutor(1) as executor:
        entry = drive_generation(executor, quick_run, impatient, [], np.tile(braking, (2, 1)))
        found = validate(executor, quick_run, impatient, braking)
    assert entry["frames"] < 2 * 80
    assert found["frames"] == impatient.evolution.validation_tracks * 80


# Replaying hard tracks


def test_a_hard_track_is_one_on_which_the_mean_agent_does_badly():
    rested = [{"tracks": [number], "returns": [[0.0], [0.0]]} for number in range(4)]
    replaying = config(replay_share=0.25, tracks=4)
    for ours, other in (([0.0, 90.0], [50.0, 50.0]), ([40.0, 50.0], [0.0, 100.0])):  # means 45, 50
        returns = [[b, a, 99.0, 99.0] for a, b in zip(ours, other, strict=True)]
        earlier = [{"tracks": [10, 11, 12, 13], "returns": returns}, *rested]
        assert generation_tracks(replaying, earlier)[0] == 11


def test_half_of_the_generations_replay_the_hardest_track_that_has_rested():
    replaying, log, difficulty = config(replay_share=0.5), [], {}
    for number in range(60):
        tracks, new = generation_tracks(replaying, log), generation_tracks(config(), log)
        recent, resting = ({entry["tracks"][0] for entry in log[-n:]} for n in (20, 4))
        if number % 2 and recent - resting:
            assert tracks == [min(recent - resting, key=difficulty.get)]
        else:
            assert tracks == new and new[0] not in difficulty
        mean = difficulty[tracks[0]] = float((7 * number) % 23)
        log.append({"tracks": tracks, "returns": [[mean - 5.0], [mean + 5.0]]})
    assert len(difficulty) == 32  # the first two of thirty replays found no rested track


def test_a_generation_of_several_tracks_mixes_the_hardest_earlier_ones_with_new_ones():
    log = [{"tracks": [10, 11, 12, 13], "returns": [[4.0, 1.0, 3.0, 2.0], [4.0, 1.0, 3.0, 2.0]]}]
    log += [{"tracks": [number], "returns": [[0.0]]} for number in range(4)]
    new = generation_tracks(config(tracks=4), log)
    for share, expected in (
        (0.25, [11, *new[:3]]),
        (0.5, [11, 13, *new[:2]]),
        (1.0, [11, 13, 12, 10]),
    ):
        assert generation_tracks(config(replay_share=share, tracks=4), log) == expected
    few = [log[0] | {"tracks": [10], "returns": [[4.0]]}, *log[1:]]
    assert generation_tracks(config(replay_share=0.5, tracks=4), few) == [10, *new[:3]]


def test_the_share_of_replayed_tracks_holds_for_any_number_of_tracks():
    for tracks, share in ((1, 0.5), (2, 0.5), (3, 0.5), (3, 0.25)):
        log = []
        for _ in range(40):
            driven = generation_tracks(config(replay_share=share, tracks=tracks), log)
            log.append({"tracks": driven, "returns": [[float(track % 23) for track in driven]]})
        new = {track for entry in log for track in entry["tracks"]}
        too_early = 6 * tracks * share  # the first generations find no rested track
        assert 40 * tracks * share - too_early <= 40 * tracks - len(new) <= 40 * tracks * share


def test_replaying_hard_tracks_survives_an_interruption(quick_run, tmp_path):
    stopped, whole = tmp_path / "stopped", without_evolution(quick_run, tmp_path / "whole")
    replaying = config(generations=8, replay_share=0.5, max_frames=20, validation_tracks=1)

    def watch(generations):
        if len(generations) == 6:
            shutil.copytree(whole, stopped)  # what is left if it is killed at this moment

    with ThreadPoolExecutor(1) as executor:
        evolve(replaying, whole, executor, watch)
        assert len(load_json(stopped / LOG)["generations"]) == 6
        evolve(replaying, stopped, executor)
    assert_equal_evolutions(stopped, whole)
    tracks = [entry["tracks"][0] for entry in load_json(whole / LOG)["generations"]]
    assert tracks[5] == tracks[0] and tracks[7] in tracks[:3]


# The strategy


def test_the_last_share_of_the_means_is_averaged_and_one_at_least():
    means = [np.full(3, float(number)) for number in range(10)]
    assert averaged_mean(means, settings(averaged_share=0.4))[0] == 7.5
    assert averaged_mean(means, settings(averaged_share=0.0))[0] == 9
    assert averaged_mean(means[:1], settings(averaged_share=0.4))[0] == 0


def simulate(strategy, chosen, generations, start=0):
    """Tell a strategy the distance to 0 as fitness; returns the log's generations."""
    logged = []
    for generation in range(start, start + generations):
        population = ask(strategy, chosen, generation)
        returns = [[-float((one**2).sum()), -float(((one - 1) ** 2).sum())] for one in population]
        tell(strategy, population, returns, [])
        logged.append({"returns": returns, "mean_checksum": crc(strategy.mean)})
    return logged


def test_the_step_size_follows_its_schedule_in_a_replay_too():
    chosen = settings(sigma=0.3, sigma_decay=0.9)
    strategy, log = make_strategy(np.zeros(8), chosen, RANDOM), {"random": RANDOM}
    log["generations"] = simulate(strategy, chosen, 5)
    replayed, _ = replay(np.zeros(8), chosen, log)
    assert np.array_equal(ask(replayed, chosen, 5), ask(strategy, chosen, 5))
    assert strategy.sigma == pytest.approx(0.3 * 0.9**5, rel=1e-12)
    with pytest.raises(ValueError, match="another mean in generation 2"):
        replay(np.zeros(8), settings(sigma=0.3, sigma_decay=0.8), log)


@pytest.mark.parametrize("rule", ["CSA", "TPA"])
@pytest.mark.parametrize("dimensions", [30, 300])
def test_the_rule_of_the_step_size_is_the_one_that_is_asked_for(rule, dimensions):
    """TPA compares two candidates ahead of the mean and behind it, CSA has no such pair."""
    chosen, rng = settings(population=8, step_size_rule=rule), np.random.default_rng(0)
    growth = []
    for better in (0, 1):  # the candidate ahead of the mean, or the one behind it
        strategy = make_strategy(np.zeros(dimensions), chosen, RANDOM)
        tell(strategy, ask(strategy, chosen, 0), list(rng.standard_normal((8, 1))), [])
        sigma, move = strategy.sigma, strategy.mean / np.linalg.norm(strategy.mean)
        population = ask(strategy, chosen, 1)
        steps = population - strategy.mean
        along = steps @ move / np.linalg.norm(steps, axis=1)
        returns = [[1.0 if number == better else -1.0] for number in (0, 1)] + [[0.0]] * 6
        tell(strategy, population, returns, [])
        growth.append(strategy.sigma / sigma)
    if rule == "TPA":
        assert along[:2] == pytest.approx([1, -1]) and growth[0] > 1 > growth[1]
    else:
        assert np.abs(along).max() < 0.9


@pytest.mark.long
def test_the_covariance_stays_round_in_the_long_run_of_notebook_04():
    """It has the same shape if CMA-ES is told random returns instead."""
    folder = PRETRAINED / "cropped_input"
    log = load_json(folder / LOG)
    run = Config.from_dict(load_json(folder / "record.json")["config"]).evolution
    rng = np.random.default_rng(0)
    for returns in (
        lambda entry: entry["returns"],
        lambda entry: rng.standard_normal(np.shape(entry["returns"])),
    ):
        start = initial_parameters(32, 256, run.initial_gas)
        strategy = make_strategy(start, run, log["random"])
        for number, entry in enumerate(log["generations"]):
            tell(strategy, ask(strategy, run, number), list(returns(entry)), [])
        axes = np.sqrt(np.linalg.eigvalsh(strategy.sm.covariance_matrix))
        assert (round(axes.min(), 2), round(axes.max(), 2)) == (1.00, 1.03)
        assert strategy.sp.c1 + strategy.sp.cmu == pytest.approx(0.000011, abs=5e-7)


def blas_threads():
    """The threads of NumPy's linear algebra."""
    found = [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]
    return max(found)


def test_an_evolution_runs_on_one_thread_where_there_are_more(quick_run, tmp_path, monkeypatch):
    folder, seen = without_evolution(quick_run, tmp_path / "run"), {}
    more = 2 if os.cpu_count() > 1 else 1

    def watch(name, threads):
        real = getattr(evolution, name)

        def watched(*given):
            found = real(*given)
            seen.setdefault(name, set()).add(threads())
            return found

        monkeypatch.setattr(evolution, name, watched)

    watch("ask", blas_threads)
    watch("drive_group", torch.get_num_threads)
    torch.set_num_threads(more)
    try:
        with threadpool_limits(more), ThreadPoolExecutor(1) as executor:
            before = blas_threads(), torch.get_num_threads()
            evolve(config(generations=2, max_frames=20), folder, executor)
    finally:
        torch.set_num_threads(1)
    assert before == (more, more) and seen == {"ask": {1}, "drive_group": {1}}


def test_a_replay_gives_the_logged_means_with_any_number_of_threads():
    start, settings, log = initial_parameters(32, 256), Config().evolution, {"random": RANDOM}
    with threadpool_limits(1):
        strategy = make_strategy(start, settings, RANDOM)
        log["generations"] = simulate(strategy, settings, 14)
    with threadpool_limits(2):
        assert np.array_equal(replay(start, settings, log)[1][-1], strategy.mean)


@pytest.mark.parametrize("rule", ["CSA", "TPA"])
def test_a_replay_restores_the_full_state(rule):
    start, chosen = initial_parameters(4, 4), settings(step_size_rule=rule)
    strategy, log = make_strategy(start, chosen, RANDOM), {"random": RANDOM, "generations": []}
    for generation in range(12):
        replayed, _ = replay(start, chosen, log)
        following = ask(replayed, chosen, generation)
        log["generations"] += simulate(strategy, chosen, 1, generation)
        tell(replayed, following, log["generations"][-1]["returns"], [])
        assert np.array_equal(replayed.mean, strategy.mean)  # bit-identical in every generation
    replayed, means = replay(start, chosen, json.loads(json.dumps(log)))
    assert len(means) == 12 and np.array_equal(means[-1], strategy.mean)
    assert strategy.countiter == replayed.countiter == 12
    assert strategy.sigma == replayed.sigma != chosen.sigma
    for state in (lambda one: one.mean, lambda one: one.C, lambda one: one.pc):
        assert np.array_equal(state(strategy), state(replayed)) and np.any(state(strategy))
    assert simulate(strategy, chosen, 3, 12) == simulate(replayed, chosen, 3, 12)


def test_another_seed_evolves_otherwise(quick_run, tmp_path):
    folder, random = without_evolution(quick_run, tmp_path / "run"), []
    world_model = evolution.load_world_model(folder)
    for one in (config(), config(seed=1), config(), Config.preset("quick", seed=1)):
        random.append(evolution.read_log(one, folder, world_model)["random"])
    populations = [make_strategy(np.zeros(8), settings(), one).ask() for one in random]
    equal = [np.array_equal(populations[0], one) for one in populations]
    assert equal == [True, False, True, False]


def test_numpy_s_global_random_state_is_left_alone_and_has_no_effect():
    def mean_of_five():
        strategy = make_strategy(np.ones(8), settings(), RANDOM)
        simulate(strategy, settings(), 5)
        return strategy.mean

    np.random.seed(1)  # noqa: NPY002
    state = np.random.get_state()[1].tolist()  # noqa: NPY002
    first = mean_of_five()
    assert np.random.get_state()[1].tolist() == state  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    assert np.array_equal(mean_of_five(), first)


# Damaged or other files


def test_a_log_that_was_changed_is_refused(first_part, tmp_path):
    folder = shutil.copytree(first_part, tmp_path / "run")
    log = load_json(folder / LOG)
    returns = log["generations"][0]["returns"]
    returns[int(np.argmin(returns))] = [1000.0]
    save_json(folder / LOG, log)
    error = r"another mean in generation 1: the log was changed.*Move it and C away"
    with pytest.raises(ValueError, match=error):
        evolve(config(), folder)
    assert load_json(folder / LOG) == log


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"generations": 2}, r"holds 6 generations, and now evolution.generations=2: .*as many"),
        ({"sigma": 0.2}, r"made with evolution.sigma=0.1, now evolution.sigma=0.2 is asked for"),
    ],
)
def test_a_log_of_another_configuration_is_refused_and_stays_as_it_was(
    changes, error, uninterrupted
):
    before = (uninterrupted / LOG).read_bytes()
    with pytest.raises(ValueError, match=rf"evolution\.json (was )?{error}"):
        evolve(config(**changes), uninterrupted)
    assert (uninterrupted / LOG).read_bytes() == before


def test_a_deleted_controller_is_written_again_without_driving(uninterrupted, tmp_path):
    folder = shutil.copytree(uninterrupted, tmp_path / "run")
    (folder / C).unlink()
    evolve(config(), folder, object())  # an executor that drives nothing
    assert_equal_evolutions(folder, uninterrupted)


# Tasks


def test_a_validation_is_the_mean_of_its_returns_on_the_same_tracks_for_every_seed(monkeypatch):
    asked, found = [], (np.array([0.0, 100.0, 800.0]), np.array([50, 60, 70]))
    monkeypatch.setattr(evolution, "drive_parallel", lambda *given: asked.append(given) or found)
    for seed in (0, 1):
        result = validate(None, None, config(seed=seed, validation_tracks=3), np.zeros(9))
        assert (result["mean"], result["frames"]) == (300.0, 180)
        assert result["returns"] == [0.0, 100.0, 800.0]
    assert asked[0][4] == asked[1][4] == track_seeds("validate", 3)


def test_a_generation_counts_every_frame_of_every_agent_on_every_track(monkeypatch):
    driven = np.arange(8.0), np.arange(8)
    monkeypatch.setattr(evolution, "drive_parallel", lambda *given: driven)
    entry = drive_generation(None, None, config(tracks=2), [], np.zeros((4, 9)))
    assert entry["frames"] == 28 and entry["returns"] == [[0, 1], [2, 3], [4, 5], [6, 7]]


def test_the_groups_of_cars_do_not_depend_on_the_processes(monkeypatch):
    sizes = []

    def run(executor, function, tasks):
        sizes.append([len(task[2]) for task in tasks])
        return [(np.zeros(len(task[2])),) * 2 for task in tasks]

    monkeypatch.setattr(evolution, "run_in_order", run)
    for processes, tracks in itertools.product((1, 2, 5), (3, 9)):
        chosen = config(processes=processes, cars=4).evolution
        drive_parallel(None, None, chosen, np.zeros((tracks, 3)), list(range(tracks)))
    assert sizes == [[2, 1], [4, 4, 1]] * 3
