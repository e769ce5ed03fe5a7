"""CMA-ES over C: a log of every generation, and an interrupt that changes nothing."""

import itertools
import json
import os
import shutil
import signal
import sys
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from stad_lab.__main__ import main
from stad_lab.agent import PRETRAINED, drive, load_controller
from stad_lab.config import Settings
from stad_lab.io.files import load_json, save_json
from stad_lab.models.controller import initial_parameters
from stad_lab.training import evolution
from stad_lab.training.dataset import TRACK_RANGES
from stad_lab.training.evolution import (
    LOG,
    ask,
    averaged_mean,
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
    vector_checksum,
)

GENERATIONS = 6


def settings(**changes):
    """Those of the quick run, with more generations."""
    return Settings.preset("quick", **({"generations": GENERATIONS} | changes))


def without_evolution(run, folder):
    """A copy of a run whose controller is not evolved yet."""
    return shutil.copytree(
        run, folder, ignore=shutil.ignore_patterns("evolution.json", "controller.safetensors")
    )


def read(folder):
    """The log in a folder."""
    return json.loads((folder / "evolution.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def one_go(quick_run, tmp_path_factory):
    """An evolution in one piece, in one process."""
    folder = without_evolution(quick_run, tmp_path_factory.mktemp("evolution") / "one_go")
    assert evolve("input_output", settings(processes=1), folder)
    return folder


@pytest.fixture(scope="module")
def first_part(quick_run, tmp_path_factory):
    """The first two generations, in two processes."""
    folder = without_evolution(quick_run, tmp_path_factory.mktemp("evolution") / "first_part")
    assert evolve("input_output", settings(processes=2, generations=2), folder)
    return folder


def test_the_fitnesses_are_the_same_for_one_and_two_processes(one_go, first_part):
    assert len(read(first_part)["generations"]) == 2
    assert read(first_part)["generations"] == read(one_go)["generations"][:2]


def test_an_evolution_in_two_parts_equals_one_in_one_go(one_go, first_part, tmp_path):
    folder = shutil.copytree(first_part, tmp_path / "run")
    assert evolve("input_output", settings(processes=1), folder)
    assert read(folder) == read(one_go)
    assert (folder / "controller.safetensors").read_bytes() == (
        one_go / "controller.safetensors"
    ).read_bytes()


def test_fewer_generations_than_there_are_is_refused_before_anything_changes(one_go):
    before = read(one_go)
    with pytest.raises(
        ValueError,
        match=r"evolution.json holds 6 generations, and now generations=2 .* at least as many",
    ):
        evolve("input_output", settings(generations=2), one_go)
    assert read(one_go) == before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals to send to a process")
def test_an_interrupted_command_goes_on_and_equals_an_uninterrupted_one(
    one_go, quick_run, tmp_path, capsys
):
    folder = without_evolution(quick_run, tmp_path / "run")
    command = ["train", "--variant", "input_output", "--settings", "quick", "--out", str(folder)]
    command += ["--set", f"generations={GENERATIONS}", "--set", "processes=1"]

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
    assert "stopped; the same command goes on from the last checkpoint" in error
    assert "Traceback" not in error
    assert 1 <= len(read(folder)["generations"]) < GENERATIONS  # it was in the middle
    assert main(command) == 0
    assert read(folder) == read(one_go)
    assert (folder / "controller.safetensors").read_bytes() == (
        one_go / "controller.safetensors"
    ).read_bytes()


def test_a_search_that_is_stopped_while_it_is_watched_goes_on_to_the_same_log(
    one_go, quick_run, tmp_path
):
    folder, seen = without_evolution(quick_run, tmp_path / "run"), []

    def watch(generations):
        seen.append(len(generations))
        if seen == [1, 2]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evolve("input_output", settings(processes=1), folder, watch=watch)
    assert evolve("input_output", settings(processes=1), folder, watch=watch)
    assert not evolve(
        "input_output", settings(processes=1), folder, watch=watch
    )  # shown, not repeated
    assert read(folder) == read(one_go) and seen == [1, 2, *range(2, GENERATIONS + 1), GENERATIONS]


def test_a_complete_evolution_is_left_alone(one_go):
    before = {path: path.stat().st_mtime_ns for path in one_go.iterdir()}
    assert not evolve("input_output", settings(processes=1), one_go)
    assert {path: path.stat().st_mtime_ns for path in one_go.iterdir()} == before


def test_every_generation_logs_worst_average_and_best(one_go):
    generations = read(one_go)["generations"]
    assert [entry["generation"] for entry in generations] == list(range(1, GENERATIONS + 1))
    curves = fitness_curves(generations)
    assert curves.shape == (3, GENERATIONS)
    for entry, (worst, average, best) in zip(generations, curves.T, strict=True):
        fitness = [sum(returns) / len(returns) for returns in entry["returns"]]
        assert len(fitness) == settings().population
        assert (worst, average, best) == pytest.approx(
            (min(fitness), sum(fitness) / len(fitness), max(fitness))
        )
        assert all(
            TRACK_RANGES["evolve"][0] <= track < TRACK_RANGES["evolve"][1]
            for track in entry["tracks"]
        )
        assert 0 < entry["frames"] <= 60 * settings().population
    assert (
        len({entry["tracks"][0] for entry in generations}) == GENERATIONS
    )  # new tracks every time
    assert (curves[0] < curves[2]).any()


def test_worst_average_and_best_of_agents_on_several_tracks():
    generations = [{"returns": [[1, 3], [10, 20], [-5, 5]]}, {"returns": [[7, 7], [9, 7], [8, 8]]}]
    assert fitness_curves(generations).tolist() == [[0, 7], [17 / 3, 23 / 3], [15, 8]]


def test_the_controller_is_the_averaged_mean_that_drove_the_validation_tracks_best(one_go):
    log = read(one_go)
    looks = {
        entry["generation"]: entry["validation"]["mean"]
        for entry in log["generations"]
        if "validation" in entry
    }
    assert list(looks) == [2, 4, 6]
    assert log["best"] == {
        "generation": max(looks, key=looks.get),
        "validation": max(looks.values()),
    }
    start = initial_parameters(32, 24, settings().initial_gas)
    _, means = replay(start, settings(), log["generations"][: log["best"]["generation"]])
    best = averaged_mean(means, settings())
    assert np.array_equal(
        load_controller(one_go / "controller.safetensors", "input_output")[0], best
    )


def test_the_first_of_two_equally_good_looks_is_kept():
    log = {"generations": [{"generation": 2, "validation": {"mean": 5.0}}], "best": None}
    assert note_best(log)
    log["generations"].append({"generation": 4, "validation": {"mean": 5.0}})
    assert not note_best(log) and log["best"] == {"generation": 2, "validation": 5.0}


def test_an_agent_s_returns_are_those_of_its_own_drives_on_the_tracks_of_the_generation(quick_run):
    several = settings(tracks=2, max_frames=90)
    population = np.array([initial_parameters(32, 24, gas=gas) for gas in (-3.0, -0.5, 0.5)])
    with ThreadPoolExecutor(1) as executor:
        entry = drive_generation(executor, quick_run, "input_output", several, [], population)
    for parameters, returns in zip(population, entry["returns"], strict=True):
        agent = make_agent(quick_run, "input_output", parameters)
        alone = [drive(agent, [track], max_frames=90)[0][0] for track in entry["tracks"]]
        assert returns == pytest.approx(alone, abs=1e-3)
    assert len({tuple(returns) for returns in entry["returns"]}) == 3


def test_an_agent_that_gets_nowhere_is_given_up_in_a_generation_and_not_in_validation(quick_run):
    impatient, braking = settings(patience=25, max_frames=80), initial_parameters(32, 24, gas=-9.0)
    with ThreadPoolExecutor(1) as executor:
        entry = drive_generation(
            executor, quick_run, "input_output", impatient, [], np.tile(braking, (2, 1))
        )
        look = validate(executor, quick_run, "input_output", impatient, braking)
    assert entry["frames"] < 2 * 80 and look["frames"] == impatient.validation_tracks * 80


def test_a_hard_track_is_one_on_which_the_average_agent_does_badly():
    rested = [{"tracks": [number], "returns": [[0.0], [0.0]]} for number in range(4)]
    back = settings(revisited_share=0.25, tracks=4)
    for ours, other in (
        ([0.0, 90.0], [50.0, 50.0]),
        ([40.0, 50.0], [0.0, 100.0]),
    ):  # 45 on average, and 50
        returns = [[b, a, 99.0, 99.0] for a, b in zip(ours, other, strict=True)]
        assert (
            generation_tracks(back, [{"tracks": [10, 11, 12, 13], "returns": returns}, *rested])[0]
            == 11
        )


def test_half_of_the_generations_go_back_to_the_hardest_track_that_has_rested():
    back, log = settings(revisited_share=0.5), []
    difficulty = {}
    for number in range(60):
        tracks = generation_tracks(back, log)
        new = generation_tracks(settings(), log)
        rested = {entry["tracks"][0] for entry in log[-20:]} - {
            entry["tracks"][0] for entry in log[-4:]
        }
        if number % 2 and rested:
            assert tracks == [
                min(rested, key=difficulty.get)
            ]  # what it was when it was last driven
        else:
            assert tracks == new and new[0] not in difficulty
        difficulty[tracks[0]] = float(
            (7 * number) % 23
        )  # of all agents together: some are better, some worse
        log.append(
            {
                "tracks": tracks,
                "returns": [[difficulty[tracks[0]] - 5.0], [difficulty[tracks[0]] + 5.0]],
            }
        )
    assert len(difficulty) == 32  # the first two of thirty goes back found nothing to go back to


def test_a_generation_of_several_tracks_mixes_the_hardest_of_before_with_new_ones():
    log = [{"tracks": [10, 11, 12, 13], "returns": [[4.0, 1.0, 3.0, 2.0], [4.0, 1.0, 3.0, 2.0]]}]
    log += [{"tracks": [number], "returns": [[0.0]]} for number in range(4)]
    new = generation_tracks(settings(tracks=4), log)
    assert generation_tracks(settings(revisited_share=0.25, tracks=4), log) == [11, *new[:3]]
    assert generation_tracks(settings(revisited_share=0.5, tracks=4), log) == [11, 13, *new[:2]]
    assert generation_tracks(settings(revisited_share=1.0, tracks=4), log) == [11, 13, 12, 10]
    few = [log[0] | {"tracks": [10], "returns": [[4.0]]}, *log[1:]]
    assert generation_tracks(settings(revisited_share=0.5, tracks=4), few) == [10, *new[:3]]


def test_the_share_of_revisited_tracks_holds_over_the_generations_for_any_number_of_tracks():
    for tracks, share in ((1, 0.5), (2, 0.5), (3, 0.5), (3, 0.25)):
        log = []
        for _ in range(40):
            driven = generation_tracks(settings(revisited_share=share, tracks=tracks), log)
            log.append({"tracks": driven, "returns": [[float(track % 23) for track in driven]]})
        new = {track for entry in log for track in entry["tracks"]}
        too_early = 6 * tracks * share  # the first generations find nothing that has rested
        assert 40 * tracks * share - too_early <= 40 * tracks - len(new) <= 40 * tracks * share


def test_going_back_to_hard_tracks_survives_an_interruption(quick_run, tmp_path):
    stopped, straight = tmp_path / "stopped", without_evolution(quick_run, tmp_path / "straight")
    back = settings(generations=8, revisited_share=0.5, max_frames=20, validation_tracks=1)

    def watch(generations):
        if len(generations) == 6:
            shutil.copytree(straight, stopped)  # what is left if it is killed at this moment

    with ThreadPoolExecutor(1) as executor:
        evolve("input_output", back, straight, executor, watch)
        assert len(read(stopped)["generations"]) == 6
        evolve("input_output", back, stopped, executor)
    assert read(stopped)["generations"] == read(straight)["generations"]
    tracks = [entry["tracks"][0] for entry in read(straight)["generations"]]
    assert tracks[5] == tracks[0] and tracks[7] in tracks[:3]


def test_the_last_share_of_the_means_is_averaged_and_one_at_least():
    means = [np.full(3, float(number)) for number in range(10)]
    assert averaged_mean(means, settings(averaged_share=0.4))[0] == 7.5
    assert averaged_mean(means, settings(averaged_share=0.0))[0] == 9
    assert averaged_mean(means[:1], settings(averaged_share=0.4))[0] == 0


def test_the_step_size_follows_its_plan_in_a_replay_too():
    planned = settings(sigma=0.3, sigma_decay=0.9)
    strategy, log = make_strategy(np.zeros(8), planned), []
    for generation in range(5):
        population = ask(strategy, planned, generation)
        assert strategy.sigma == pytest.approx(0.3 * 0.9**generation, rel=1e-12)
        returns = [[-float((agent**2).sum())] for agent in population]
        strategy.tell(population, [-one[0] for one in returns])
        log.append({"returns": returns, "mean_checksum": vector_checksum(strategy.mean)})
    replayed, _ = replay(np.zeros(8), planned, log)
    assert np.array_equal(ask(replayed, planned, 5), ask(strategy, planned, 5))
    with pytest.raises(ValueError, match="another mean in generation 2"):
        replay(np.zeros(8), settings(sigma=0.3, sigma_decay=0.8), log)


def test_from_300_parameters_on_two_agents_stand_ahead_of_the_mean_and_behind_it_to_find_the_step_size():
    quick, random = settings(population=8, sigma_decay=0.0), np.random.default_rng(0)
    for parameters in (299, 300):
        growth = []
        for better in (0, 1):  # the one ahead of the mean, the one behind it
            strategy = make_strategy(np.zeros(parameters), quick)
            tell(strategy, ask(strategy, quick, 0), list(random.standard_normal((8, 1))), [])
            sigma, move = strategy.sigma, strategy.mean / np.linalg.norm(strategy.mean)
            population = ask(strategy, quick, 1)
            steps = population - strategy.mean
            along = steps @ move / np.linalg.norm(steps, axis=1)
            tell(
                strategy,
                population,
                [[[1.0, -1.0][number != better]] for number in (0, 1)] + [[0.0]] * 6,
                [],
            )
            growth.append(strategy.sigma / sigma)
        if parameters < 300:
            assert np.abs(along).max() < 0.5
        else:
            assert along[:2] == pytest.approx([1, -1]) and np.abs(along[2:]).max() < 0.5
            assert growth[0] > 1 > growth[1]


@pytest.mark.long
def test_the_shape_stays_round_in_the_long_run_of_notebook_04_as_with_scores_drawn_at_random():
    log, long_run = (
        load_json(PRETRAINED / "input" / LOG),
        load_json(PRETRAINED / "input" / "record.json"),
    )
    chosen, random = Settings.from_dict(long_run["settings"]), np.random.default_rng(0)
    for told in (
        lambda entry: entry["returns"],
        lambda entry: random.standard_normal(np.shape(entry["returns"])),
    ):
        strategy = make_strategy(initial_parameters(32, 256, chosen.initial_gas), chosen)
        for number, entry in enumerate(log["generations"]):
            tell(strategy, ask(strategy, chosen, number), list(told(entry)), [])
        axes = np.sqrt(np.linalg.eigvalsh(strategy.sm.covariance_matrix))
        assert (round(axes.min(), 2), round(axes.max(), 2)) == (1.00, 1.03)
        assert strategy.sp.c1 + strategy.sp.cmu == pytest.approx(0.000011, abs=5e-7)


def test_a_search_runs_on_one_thread_wherever_more_are_to_be_had(quick_run, tmp_path, monkeypatch):
    folder, seen, more = (
        without_evolution(quick_run, tmp_path / "run"),
        {},
        2 if os.cpu_count() > 1 else 1,
    )

    def of_numpy():
        return max(
            library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
        )

    def watch(name, threads):
        real = getattr(evolution, name)

        def watched(*given):
            found = real(*given)
            seen.setdefault(name, set()).add(threads())
            return found

        monkeypatch.setattr(evolution, name, watched)

    watch("ask", of_numpy)
    watch("drive_group", torch.get_num_threads)
    torch.set_num_threads(more)
    try:
        with threadpool_limits(more), ThreadPoolExecutor(1) as executor:
            before = of_numpy(), torch.get_num_threads()
            evolve("input_output", settings(generations=2, max_frames=20), folder, executor)
    finally:
        torch.set_num_threads(1)
    assert before == (more, more) and seen == {"ask": {1}, "drive_group": {1}}


def test_a_replay_comes_to_the_logged_means_with_any_number_of_threads():
    start, log = initial_parameters(32, 256), []
    with threadpool_limits(1):
        strategy = make_strategy(start, Settings.preset("laptop"))
        for generation in range(14):
            population = ask(strategy, Settings.preset("laptop"), generation)
            returns = [[-float((agent**2).sum())] for agent in population]
            strategy.tell(population, [-np.mean(one) for one in returns])
            log.append({"returns": returns, "mean_checksum": vector_checksum(strategy.mean)})
    with threadpool_limits(2):
        assert np.array_equal(replay(start, Settings.preset("laptop"), log)[1][-1], strategy.mean)


def test_a_replay_restores_the_full_state():
    start = initial_parameters(4, 4)
    strategy, log = make_strategy(start, settings()), []
    for _ in range(12):
        population = strategy.ask()
        returns = [
            [-float((agent**2).sum()), -float(((agent - 1) ** 2).sum())] for agent in population
        ]
        strategy.tell(population, [-np.mean(pair) for pair in returns])
        replayed, _ = replay(start, settings(), log)
        following = replayed.ask()
        assert np.array_equal(following, population)  # the next population, to the last bit
        log.append({"returns": returns, "mean_checksum": zlib.crc32(strategy.mean.tobytes())})
    replayed, means = replay(start, settings(), json.loads(json.dumps(log)))
    assert len(means) == 12 and np.array_equal(means[-1], strategy.mean)
    assert strategy.countiter == replayed.countiter == 12
    assert strategy.sigma == replayed.sigma != settings().sigma
    for state in (lambda s: s.mean, lambda s: s.C, lambda s: s.pc, lambda s: s.adapt_sigma.ps):
        assert np.array_equal(state(strategy), state(replayed))
        assert np.any(state(strategy))
    for _ in range(3):
        population = strategy.ask()
        assert np.array_equal(population, replayed.ask())
        for one in (strategy, replayed):
            one.tell(population, [float((agent**2).sum()) for agent in population])


def test_another_seed_evolves_otherwise():
    changes = ({}, {"evolution_seed": 0}, {"seed": 1}, {"evolution_seed": 1})
    populations = [make_strategy(np.zeros(8), settings(**change)).ask() for change in changes]
    assert np.array_equal(populations[0], populations[1])
    assert not np.array_equal(populations[0], populations[2])
    assert not np.array_equal(populations[0], populations[3])


def test_numpy_s_global_random_state_is_untouched_and_untouching():
    def best_of_five():
        strategy = make_strategy(np.ones(8), settings())
        for _ in range(5):
            population = strategy.ask()
            strategy.tell(population, [float((agent**2).sum()) for agent in population])
        return strategy.mean

    np.random.seed(1)
    state = np.random.get_state()[1].tolist()
    first = best_of_five()
    assert np.random.get_state()[1].tolist() == state
    np.random.seed(2)
    assert np.array_equal(best_of_five(), first)


def test_a_log_that_was_changed_is_refused(first_part, tmp_path):
    folder = shutil.copytree(first_part, tmp_path / "run")
    log = read(folder)
    returns = log["generations"][0]["returns"]
    returns[int(np.argmin(returns))] = [1000.0]
    save_json(folder / "evolution.json", log)
    with pytest.raises(
        ValueError,
        match=r"another mean in generation 1 than the run had: .*changed.*Start in a new folder",
    ):
        evolve("input_output", settings(), folder)
    assert {**read(folder), "checksum": 0} == {**log, "checksum": 0}


def test_a_damaged_log_is_refused(first_part, tmp_path):
    folder = shutil.copytree(first_part, tmp_path / "run")
    log = folder / "evolution.json"
    log.write_text(log.read_text(encoding="utf-8")[:-200])
    with pytest.raises(ValueError, match=r"evolution.json is damaged .*: delete it"):
        evolve("input_output", settings(), folder)


def test_a_log_of_other_settings_is_refused(first_part):
    with pytest.raises(
        ValueError,
        match=r"holds a run with sigma=0.1, and now sigma=0.2 is asked for: choose another",
    ):
        evolve("input_output", settings(sigma=0.2), first_part)


def test_a_deleted_controller_is_made_again(one_go, tmp_path):
    folder = shutil.copytree(one_go, tmp_path / "run")
    (folder / "controller.safetensors").unlink()
    evolve("input_output", settings(), folder)
    assert (folder / "controller.safetensors").read_bytes() == (
        one_go / "controller.safetensors"
    ).read_bytes()


def test_a_damaged_controller_is_not_taken_for_a_finished_run(one_go, tmp_path):
    folder = shutil.copytree(one_go, tmp_path / "run")
    file = folder / "controller.safetensors"
    file.write_bytes(file.read_bytes()[:-10])
    with pytest.raises(ValueError, match=r"controller.safetensors is damaged"):
        evolve("input_output", settings(), folder)


def test_a_look_is_the_mean_of_its_returns_on_the_same_tracks_for_every_seed(monkeypatch):
    asked, found = [], (np.array([0.0, 100.0, 800.0]), np.array([50, 60, 70]))
    monkeypatch.setattr(
        "stad_lab.training.evolution.drive_parallel", lambda *given: asked.append(given) or found
    )
    for seed in (0, 1):
        chosen = Settings.preset("quick", validation_tracks=3, seed=seed, evolution_seed=seed)
        look = validate(None, None, "input", chosen, np.zeros(9))
        assert (look["mean"], look["returns"], look["frames"]) == (300.0, [0.0, 100.0, 800.0], 180)
    assert asked[0][4] == asked[1][4]


def test_a_generation_counts_every_frame_of_every_agent_on_every_track(monkeypatch):
    monkeypatch.setattr(
        "stad_lab.training.evolution.drive_parallel", lambda *given: (np.arange(8.0), np.arange(8))
    )
    entry = drive_generation(
        None, None, "input", Settings.preset("quick", tracks=2), [], np.zeros((4, 9))
    )
    assert entry["frames"] == 28 and entry["returns"] == [[0, 1], [2, 3], [4, 5], [6, 7]]


def test_the_groups_of_cars_do_not_depend_on_the_processes(monkeypatch):
    sizes = []

    def run(executor, function, tasks):
        sizes.append([len(task[3]) for task in tasks])
        return [(np.zeros(len(task[3])),) * 2 for task in tasks]

    monkeypatch.setattr("stad_lab.training.evolution.run_in_order", run)
    for processes, tracks in itertools.product((1, 2, 5), (3, 9)):
        chosen = Settings.preset("quick", processes=processes, cars=4)
        drive_parallel(None, None, "input", np.zeros((tracks, 3)), list(range(tracks)), chosen)
    assert sizes == [[2, 1], [4, 4, 1]] * 3
