"""Evaluation: Gymnasium's own tracks, every episode recorded, and no file of a run overwritten."""

import errno
import functools
import io
import os
import shutil
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest

from stad_lab import load_agent, make_env
from stad_lab.agent import PRETRAINED
from stad_lab.cli import main
from stad_lab.config import TRACK_RANGES
from stad_lab.evaluation import evaluate as evaluation
from stad_lab.evaluation.evaluate import (
    check_output,
    describe,
    evaluate,
    load_evaluation,
    report,
)
from stad_lab.evaluation.statistics import summarise
from stad_lab.io.files import checksum_of_arrays, load_json, save_json
from stad_lab.io.workers import run_tasks
from stad_lab.training.pipeline import RUN_FILES

TRACK = 3
RUN_TASKS = "stad_lab.evaluation.evaluate.run_tasks"


@pytest.fixture(scope="module")
def whole(straight_run):
    """One whole episode with Gymnasium's own renderer."""
    return evaluate(straight_run, episodes=1, first_track=TRACK, processes=1)


@pytest.fixture(scope="module")
def fast(straight_run):
    """Two whole episodes with the fast renderer."""
    return evaluate(straight_run, episodes=2, first_track=10, fast=True)


def untimed(result):
    """A result without its seconds, its checksum, and how and where it was driven."""
    changes = ("seconds", "checksum", "made_with")
    return {name: value for name, value in result.items() if name not in changes}


def one_episode(*given):
    """In place of `run_tasks`: 5 points in 7 frames, without driving."""
    yield 0, (np.array([5.0]), np.array([7]))


def test_a_script_with_gymnasium_alone_finds_the_same_return(whole, straight_run):
    env, agent = gymnasium.make("CarRacing-v3"), load_agent(straight_run)
    observation, _ = env.reset(seed=TRACK)
    agent.reset()
    total, frames, ended = 0.0, 0, False
    while not ended:
        action = agent.act(observation)
        assert env.action_space.contains(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, frames, ended = total + reward, frames + 1, terminated or truncated
    env.close()
    assert whole["renderer"] == "gymnasium"
    assert 200 < frames < 1000 and terminated  # off the field, at the cost of 100
    episode = {"track": TRACK, "return": pytest.approx(total, abs=1e-6), "frames": frames}
    assert whole["episodes"] == [episode]


def test_every_episode_is_recorded(fast, straight_run):
    assert [episode["track"] for episode in fast["episodes"]] == [10, 11]
    returns = np.array([episode["return"] for episode in fast["episodes"]])
    assert len(set(returns)) > 1
    assert summarise(returns).items() <= fast.items()
    assert all(0 < episode["frames"] <= 1000 for episode in fast["episodes"])
    assert (fast["kind"], fast["variant"], fast["renderer"]) == (
        "evaluation",
        "input_output",
        "fast",
    )
    drove = checksum_of_arrays(parameters=load_agent(straight_run).parameters)
    assert fast["controller"] == drove


def test_an_evaluation_goes_to_the_screen_and_to_a_file_named_after_what_was_asked(
    straight_run, fast, tmp_path, capsys
):
    run = shutil.copytree(straight_run, tmp_path / "run")
    options = ["--fast", "--episodes", "2", "--first-track", "10", "--processes", "1"]
    assert main(["evaluate", "--agent", str(run), *options]) == 0
    told = capsys.readouterr().out
    file = run / "evaluation-run-fast-from-10-2-tracks.json"
    result = load_evaluation(file)
    assert untimed(result) == untimed(fast)  # one process or two: the same numbers
    assert result["seconds"] > 0
    assert describe(fast) in told and str(file) in told


def test_a_result_names_the_controller_that_drove_even_if_training_saves_another_meanwhile(
    straight_run, tmp_path, monkeypatch
):
    run = shutil.copytree(straight_run, tmp_path / "run")
    drove = load_agent(run).parameters

    def save_another(executor, function, tasks):
        (run / "controller.safetensors").write_bytes(b"another")
        assert np.array_equal(tasks[0][1], drove)
        yield from one_episode()

    monkeypatch.setattr(RUN_TASKS, save_another)
    assert evaluate(run, episodes=1)["controller"] == checksum_of_arrays(parameters=drove)


def test_an_interrupted_evaluation_continues_with_the_tracks_that_are_left(
    straight_run, fast, tmp_path, monkeypatch
):
    asked, file, tasks = (straight_run, 2, 10, True), tmp_path / "unfinished.json", []

    def stop_after_one(executor, function, given):
        yield next(run_tasks(executor, function, given))
        raise KeyboardInterrupt

    def noting(executor, function, given):
        tasks.append(len(given))
        return run_tasks(executor, function, given)

    monkeypatch.setattr(RUN_TASKS, stop_after_one)
    with pytest.raises(KeyboardInterrupt):
        evaluate(*asked, unfinished=file)
    monkeypatch.setattr(RUN_TASKS, noting)
    assert untimed(evaluate(*asked, unfinished=file)) == untimed(fast)
    assert tasks == [1]
    begun = load_json(file)
    for other in (
        {"controller": "of another C"},
        {"vae": "of the same V, less precise"},
        {"processor": "of another machine"},
    ):
        assert other.keys() <= begun["asked"].keys()
        save_json(file, begun | {"asked": begun["asked"] | other})
        assert evaluate(*asked, unfinished=file)["episodes"] == fast["episodes"]
        assert tasks.pop() == 2


def test_the_command_continues_with_the_tracks_that_are_left(straight_run, tmp_path, monkeypatch):
    run, asked = shutil.copytree(straight_run, tmp_path / "run"), []

    def stop_after_one(executor, function, tasks):
        asked.append([task[2] for task in tasks])
        yield from one_episode()
        if len(tasks) > 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(RUN_TASKS, stop_after_one)
    command = ["evaluate", "--agent", str(run), "--episodes", "2"]
    assert [main(command), main(command)] == [130, 0]
    assert asked == [[[0], [1]], [[1]]]
    assert not list(run.glob("unfinished*"))


def test_a_full_disk_costs_the_right_to_continue_but_not_the_result(
    straight_run, tmp_path, monkeypatch
):
    def refuse(*given):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RUN_TASKS, one_episode)
    monkeypatch.setattr("stad_lab.evaluation.evaluate.save_json", refuse)
    found = evaluate(straight_run, episodes=1, unfinished=tmp_path / "unfinished.json")
    assert found["mean"] == 5.0


def test_an_evaluation_is_written_even_if_nobody_reads_what_is_printed(
    straight_run, tmp_path, monkeypatch
):
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(RUN_TASKS, one_episode)
    monkeypatch.setattr("sys.stdout", Closed())
    file = tmp_path / "evaluation.json"
    command = ["evaluate", "--agent", straight_run, "--episodes", 1, "--json", file]
    assert main(list(map(str, command))) == 141
    assert [one.name for one in tmp_path.iterdir()] == ["evaluation.json"]
    assert load_evaluation(file)["mean"] == 5.0


@pytest.mark.parametrize("name", [*RUN_FILES, "notes.json", "00000.frames.npy"])
def test_an_evaluation_overwrites_no_other_file(name, quick_run, tmp_path, capsys):
    run = shutil.copytree(quick_run, tmp_path / "run")
    (run / "notes.json").write_text('{"mine": 1}')
    file = run / "dataset" / name if (run / "dataset" / name).exists() else run / name
    before = file.read_bytes() if file.exists() else None
    command = ["evaluate", "--agent", run, "--fast", "--episodes", 1, "--json", file]
    assert main(list(map(str, command))) == 2
    assert "choose another name" in capsys.readouterr().err
    assert (file.read_bytes() if file.exists() else None) == before


def test_an_earlier_result_may_be_overwritten_by_one_of_its_kind_alone(tmp_path):
    shutil.copy(PRETRAINED / "frame" / "evaluation.json", tmp_path / "result.json")
    check_output(tmp_path / "result.json", "evaluation")
    check_output(tmp_path / "new.json", "probe")
    with pytest.raises(ValueError, match="is no earlier probe: choose another name"):
        check_output(tmp_path / "result.json", "probe")


def test_a_file_may_have_the_longest_name_that_the_system_takes(tmp_path):
    save_json(tmp_path / f"{'n' * 250}.json", {"kind": "a"})
    assert load_json(tmp_path / f"{'n' * 250}.json") == {"kind": "a"}


def test_a_result_is_written_where_it_is_asked_for_and_not_over_a_folder_or_a_device(
    straight_run, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(RUN_TASKS, one_episode)
    wanted = tmp_path / "made" / "result.json"
    command = ["evaluate", "--agent", str(straight_run), "--episodes", "1", "--json"]
    assert main([*command, str(wanted)]) == 0
    assert len(load_evaluation(wanted)["episodes"]) == 1
    assert main([*command, str(wanted.parent)]) == 2
    assert "is a folder: give the name of a file" in capsys.readouterr().err
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "device")
        assert main([*command, str(tmp_path / "device")]) == 2
        assert "is no ordinary file: give the name of a file" in capsys.readouterr().err
        assert (tmp_path / "device").is_fifo()


@pytest.fixture
def result(fast):
    """An evaluation that a test may change."""
    return {**fast, "episodes": [dict(episode) for episode in fast["episodes"]]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda found: found.update(mean=950.0), r"says mean=950.0, its episodes give"),
        (lambda found: found.update(above_900=0.5), r"says above_900=0.5, its episodes give 0.0"),
        (lambda found: found.update(episodes=[]), "has 0 episodes on 0 tracks"),
        (lambda found: found["episodes"][1].update(track=10), "has 2 episodes on 1 tracks"),
        (lambda found: found["episodes"][1].update({"return": 900.0}), "says mean="),
        (lambda found: found.update(kind="probe"), "is of kind 'probe': expected 'evaluation'"),
    ],
)
def test_an_evaluation_whose_summary_is_not_that_of_its_episodes_is_refused(
    change, message, result, tmp_path
):
    save_json(tmp_path / "evaluation.json", result)
    assert load_evaluation(tmp_path / "evaluation.json")["mean"] == result["mean"]
    change(result)
    save_json(tmp_path / "evaluation.json", result)
    with pytest.raises(ValueError, match=message):
        load_evaluation(tmp_path / "evaluation.json")


def test_the_screen_shows_what_the_summary_says(fast):
    text = describe(fast)
    for number in (fast["mean"], fast["standard_deviation"], *fast["interval"]):
        assert f"{number:.1f}" in text
    assert "2 episodes (tracks 10 to 11, renderer: fast)" in text
    assert "% of the episodes above 900" in text


def test_the_summary_of_a_few_returns_by_hand():
    result = report([4, 5, 6], np.array([800.0, 900.0, 1000.0]), np.array([7, 8, 9]))
    assert result["mean"] == 900
    assert result["standard_deviation"] == pytest.approx(100)  # of the sample: divided by n - 1
    assert result["above_900"] == pytest.approx(1 / 3)  # 900 itself is not above
    low, high = result["interval"]
    assert 800 <= low < 900 < high <= 1000
    assert result["episodes"][1] == {"track": 5, "return": 900.0, "frames": 8}


def test_the_interval_is_that_of_the_mean():
    returns = np.random.default_rng(0).normal(500, 100, 400)
    error = 1.96 * returns.std(ddof=1) / 20
    expected = [returns.mean() - error, returns.mean() + error]
    assert summarise(returns)["interval"] == pytest.approx(expected, abs=1)
    assert summarise(np.full(7, 321.0))["interval"] == [321, 321]
    one = summarise(np.array([12.5]))
    assert (one["standard_deviation"], one["interval"]) == (0.0, [12.5, 12.5])


@pytest.mark.parametrize(
    ("first", "episodes"),
    [(-1, 1), (TRACK_RANGES["test"][1], 1), (999_950, 100), (0, 0), (0, 10_001)],
)
def test_tracks_outside_the_test_range_are_refused(first, episodes, straight_run):
    message = f"episodes={episodes} from first_track={first}: expected 1 to 10000 episodes, on"
    with pytest.raises(ValueError, match=f"{message} tracks 0 to 999999"):
        evaluate(straight_run, episodes, first)


def test_without_fast_the_environment_is_gymnasium_s_own(straight_run, monkeypatch):
    made = []

    def noting(fast=True, **options):
        made.append(fast)
        return make_env(True, **options)

    monkeypatch.setattr("stad_lab.agent.make_env", noting)
    briefly = functools.partial(evaluation.drive_group, limits={"max_frames": 20})
    monkeypatch.setattr(evaluation, "drive_group", briefly)
    with ThreadPoolExecutor(1) as executor:
        for fast in (False, True):
            evaluate(straight_run, 1, 3, fast, executor=executor)
    assert made == [False]
