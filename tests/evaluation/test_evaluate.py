"""Evaluation: official tracks, every episode on record, numbers that a script of one's own finds again."""

import errno
import io
import shutil
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest

from stad_lab import load_agent, make_env
from stad_lab.__main__ import main
from stad_lab.agent import load_controller, save_controller
from stad_lab.evaluation.evaluate import describe, evaluate, summarise
from stad_lab.io.files import checksum, load_json, save_json
from stad_lab.io.workers import run_tasks
from stad_lab.training.dataset import TRACK_RANGES

TRACK = 3


@pytest.fixture(scope="module")
def official(straight_run):
    """One whole episode with Gymnasium's own renderer."""
    return evaluate("input_output", straight_run, episodes=1, first_track=TRACK, processes=1)


@pytest.fixture(scope="module")
def fast(straight_run):
    """Two whole episodes with the fast renderer."""
    return evaluate("input_output", straight_run, episodes=2, first_track=10, fast=True)


def test_a_script_with_gymnasium_alone_finds_the_same_return(official, straight_run):
    env = gymnasium.make("CarRacing-v3")
    agent = load_agent("input_output", straight_run)
    observation, _ = env.reset(seed=TRACK)
    agent.reset()
    total = frames = 0
    ended = False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step(agent.act(observation))
        total, frames, ended = total + reward, frames + 1, terminated or truncated
    assert official["renderer"] == "official"
    assert 200 < frames < 1000 and terminated  # off the field, at the cost of 100
    assert official["episodes"] == [
        {"track": TRACK, "return": pytest.approx(total, abs=1e-6), "frames": frames}
    ]


def test_every_episode_is_on_record(fast):
    assert [episode["track"] for episode in fast["episodes"]] == [10, 11]
    returns = np.array([episode["return"] for episode in fast["episodes"]])
    assert len(set(returns)) > 1
    assert {name: fast[name] for name in summarise(returns)} == summarise(returns)
    for episode in fast["episodes"]:
        assert 0 < episode["frames"] <= 1000
    assert (fast["variant"], fast["renderer"]) == ("input_output", "fast")


def test_an_evaluation_goes_to_the_screen_and_to_a_file_that_is_not_the_official_one_s(
    straight_run, fast, tmp_path, capsys
):
    run = shutil.copytree(straight_run, tmp_path / "run")
    arguments = ["evaluate", "--variant", "input_output", "--path", run, "--fast", "--episodes", 2]
    assert (
        main([str(argument) for argument in (*arguments, "--first-track", 10, "--processes", 1)])
        == 0
    )
    told = capsys.readouterr().out
    file = run / "evaluation-input_output-fast-from-10-2-tracks.json"
    result = load_json(file)
    assert result | {"seconds": 0} == fast | {"seconds": 0}  # one process or two: the same numbers
    assert result["seconds"] > 0
    assert describe(fast) in told and str(file) in told


def test_a_result_names_the_controller_that_drove_if_a_search_finds_a_better_one_meanwhile(
    straight_run, tmp_path, monkeypatch
):
    run = shutil.copytree(straight_run, tmp_path / "run")
    drove = (run / "controller.safetensors").read_bytes()

    def find_a_better_one(*given):
        (run / "controller.safetensors").write_bytes(b"another")
        yield 0, (np.array([1.0]), np.array([7]))

    monkeypatch.setattr("stad_lab.evaluation.evaluate.run_tasks", find_a_better_one)
    assert evaluate("input_output", run, episodes=1)["controller_sha256"] == checksum(drove)


def test_a_controller_that_changes_while_it_is_read_is_read_again(
    straight_run, tmp_path, monkeypatch
):
    run, readings = shutil.copytree(straight_run, tmp_path / "run"), []
    file = run / "controller.safetensors"
    old = load_controller(file, "input_output")

    def read_and_save_a_better_one(*given):
        agent = load_agent(*given)
        if len(readings) < 2:  # the first reading, and the one between the two checksums
            save_controller(
                file, old[0] + len(readings) + 1, **{k: v for k, v in old[1].items() if k != "part"}
            )
        readings.append(agent.parameters)
        return agent

    monkeypatch.setattr("stad_lab.evaluation.evaluate.load_agent", read_and_save_a_better_one)
    driven = []
    monkeypatch.setattr(
        "stad_lab.evaluation.evaluate.run_tasks",
        lambda *given: driven.append(given[2]) or [(0, ([1.0], [7]))],
    )
    found = evaluate("input_output", run, episodes=1)
    assert found["controller_sha256"] == checksum(file.read_bytes())
    assert np.array_equal(driven[0][0][2], load_controller(file, "input_output")[0])


def test_an_interrupted_evaluation_goes_on_with_the_tracks_that_are_left(
    straight_run, fast, tmp_path, monkeypatch
):
    chosen, file, done = (
        ("input_output", straight_run, 2, 10, True),
        tmp_path / "unfinished.json",
        [],
    )

    def refuse_to_write(*given):
        raise OSError("[Errno 28] No space left on device")

    def interrupt_after_one(executor, function, tasks):
        done.append(len(tasks))
        yield next(run_tasks(executor, function, tasks))
        raise KeyboardInterrupt

    monkeypatch.setattr("stad_lab.evaluation.evaluate.run_tasks", interrupt_after_one)
    with pytest.raises(KeyboardInterrupt):
        evaluate(*chosen, unfinished=file)
    monkeypatch.setattr(
        "stad_lab.evaluation.evaluate.run_tasks",
        lambda *given: done.append(len(given[2])) or run_tasks(*given),
    )
    result = evaluate(*chosen, unfinished=file)
    assert done == [2, 1] and result | {"seconds": 0} == fast | {"seconds": 0}
    drove = load_json(file)
    monkeypatch.setattr("stad_lab.evaluation.evaluate.save_json", refuse_to_write)
    for other in (
        {"controller_sha256": "of another C"},
        {"weights": ["of the same V, half as precise", "of M"]},
    ):
        save_json(file, drove | {"identity": drove["identity"] | other})
        assert evaluate(*chosen, unfinished=file)["episodes"] == fast["episodes"] and done[-1] == 2


def test_the_command_goes_on_with_the_tracks_that_are_left(straight_run, tmp_path, monkeypatch):
    run, asked = shutil.copytree(straight_run, tmp_path / "run"), []

    def stop_after_one(executor, function, tasks):
        asked.append([task[3] for task in tasks])
        yield 0, (np.array([5.0]), np.array([7]))
        if len(tasks) > 1:
            raise KeyboardInterrupt

    monkeypatch.setattr("stad_lab.evaluation.evaluate.run_tasks", stop_after_one)
    command = ["evaluate", "--variant", "input_output", "--path", str(run), "--episodes", "2"]
    assert [main(command), main(command)] == [130, 0]
    assert asked == [[[0], [1]], [[1]]]
    assert not list(run.glob("unfinished*"))


def test_an_evaluation_is_written_though_nobody_reads_what_is_printed(
    straight_run, tmp_path, monkeypatch
):
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(
        "stad_lab.evaluation.evaluate.run_tasks",
        lambda *given: [(0, (np.array([5.0]), np.array([7])))],
    )
    monkeypatch.setattr("sys.stdout", Closed())
    command = [
        "evaluate",
        "--variant",
        "input_output",
        "--path",
        str(straight_run),
        "--episodes",
        "1",
    ]
    assert main([*command, "--json", str(tmp_path / "evaluation.json")]) == 2
    assert [file.name for file in tmp_path.iterdir()] == ["evaluation.json"]
    assert load_json(tmp_path / "evaluation.json")["mean"] == 5.0


def test_the_screen_shows_what_the_summary_says(fast):
    text = describe(fast)
    for number in (fast["mean"], fast["standard_deviation"], *fast["interval"]):
        assert f"{number:.1f}" in text
    assert "2 episodes (tracks 10 to 11, fast renderer)" in text
    assert "% of the episodes above 900" in text


def test_the_summary_of_a_few_returns_by_hand():
    result = summarise(np.array([800.0, 900.0, 1000.0]))
    assert result["mean"] == 900
    assert result["standard_deviation"] == pytest.approx(100)  # of the sample: divided by n - 1
    assert result["above_900"] == pytest.approx(1 / 3)  # 900 itself is not above
    low, high = result["interval"]
    assert 800 <= low < 900 < high <= 1000


def test_the_interval_is_that_of_the_mean():
    returns = np.random.default_rng(0).normal(500, 100, 400)
    error = 1.96 * returns.std(ddof=1) / 20
    assert summarise(returns)["interval"] == pytest.approx(
        [returns.mean() - error, returns.mean() + error], abs=1
    )
    assert summarise(np.full(7, 321.0))["interval"] == [321, 321]


def test_one_episode_has_no_deviation():
    assert summarise(np.array([12.5])) == {
        "mean": 12.5,
        "standard_deviation": 0.0,
        "interval": [12.5, 12.5],
        "above_900": 0.0,
    }


@pytest.mark.parametrize(
    ("first", "episodes"),
    [(-1, 1), (TRACK_RANGES["test"][1], 1), (999_950, 100), (0, 0), (0, 10_001)],
)
def test_tracks_outside_the_test_range_are_refused(first, episodes, straight_run):
    message = f"episodes={episodes} from first_track={first}: expected 1 to 10000 episodes, on tracks 0 to 999999"
    with pytest.raises(ValueError, match=message):
        evaluate("input_output", straight_run, episodes, first)


def test_official_means_gymnasium_s_own_environment(straight_run, monkeypatch):
    made = []
    monkeypatch.setattr(
        "stad_lab.agent.make_env",
        lambda fast=True, **how: made.append(fast) or make_env(True, **how),
    )
    with ThreadPoolExecutor(1) as executor:
        for fast in (False, True):
            evaluate("input_output", straight_run, 1, 3, fast, executor=executor)
    assert made == [False, True]
