"""The experiments: one command runs one, continues it, and keeps it in the tables."""

import functools
import inspect
import shutil
from concurrent.futures import ThreadPoolExecutor

import pytest

from stad_lab.config import Config
from stad_lab.evaluation import evaluate as evaluation
from stad_lab.evaluation.evaluate import evaluate
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import MDN_RNN_FILE, VAE_FILE
from stad_lab.training.evolution import LOG
from stad_lab.training.record import RECORD, total_budget
from stad_lab.training.subspace import COMPONENTS_FILE, START_FILE
from stad_study import run as replication
from stad_study import tables
from stad_study.cli import main
from stad_study.experiments import BASELINE_DRIVERS, EXPERIMENTS, Experiment
from stad_study.run import EVALUATION, describe_time, keep, replicate

BRIEF = {"generations": 2, "max_frames": 30}
FIRST = Config.preset(
    "quick",
    variant="input",
    processes=1,
    vae={"steps": 8, "batch": 8},
    mdn_rnn={"steps": 4},
    evolution=BRIEF,
)
SECOND = FIRST.replace(data={"agent_episodes": 2}, evolution={"generations": 4, "components": 8})
TUNED = SECOND.replace(evolution={"generations": 2, "tracks": 2, "sigma": 0.02})
DECLARED = {
    "two": Experiment("two iterations", SECOND, FIRST, seeds=(0, 1)),
    "one": Experiment("one iteration", FIRST, seeds=(0,)),
    "blind": Experiment("C sees z", FIRST.replace(evolution={"features": "z"}), None, (3,), "one"),
    "whole": Experiment("whole runs", FIRST, seeds=(0, 1), retrained=True),
    "tuned": Experiment("fine-tuning", TUNED, seeds=(0, 1), base="two"),
}


@pytest.fixture(scope="module", autouse=True)
def briefly():
    """Some brief experiments, evaluated on one track for 60 frames with the fast renderer."""
    with pytest.MonkeyPatch.context() as patch:
        for name, experiment in DECLARED.items():
            patch.setitem(EXPERIMENTS, name, experiment)
        patch.setattr(replication, "TRACKS", 1)
        patch.setattr(tables, "TRACKS", 1)
        patch.setattr(replication, "evaluate", functools.partial(evaluate, fast=True))
        patch.setattr(tables, "check_evaluation", lambda *given: None)
        drive = functools.partial(evaluation.drive_group, limits={"max_frames": 60})
        patch.setattr(evaluation, "drive_group", drive)
        yield


def run(name, folder, seeds=None):
    """`replicate` with a thread as its worker."""
    with ThreadPoolExecutor(1) as executor:
        return replicate(name, folder, executor, seeds)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of "two" and "blind", and their summaries."""
    folder = tmp_path_factory.mktemp("experiments")
    return folder, {name: run(name, folder) for name in ("two", "blind")}


@pytest.fixture
def copy(made, tmp_path):
    """A copy of the folder of both experiments."""
    return shutil.copytree(made[0], tmp_path / "copy")


def state(folder):
    """When each file was written; of a record, what it says."""
    return {
        path: load_json(path) if path.name == RECORD else path.stat().st_mtime_ns
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_each_seed_runs_cma_es_on_the_same_v_and_m(made):
    folders = [made[0] / "two" / f"seed{seed}" for seed in (0, 1)]
    for name in (VAE_FILE, MDN_RNN_FILE, COMPONENTS_FILE, START_FILE):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()
    logs = [load_json(folder / LOG) for folder in folders]
    assert [log["vae"] for log in logs] == [logs[0]["vae"]] * 2
    for part in ("tracks", "returns"):
        assert logs[0]["generations"][0][part] != logs[1]["generations"][0][part]
    assert made[1]["two"]["seeds"] == 2


def test_a_shared_world_model_is_trained_in_the_folder_of_its_own_experiment(made):
    folder, _ = made
    assert {path.name for path in (folder / "blind").iterdir()} == {"seed3"}
    assert (folder / "one" / "world").is_dir() and not (folder / "one" / "seed0").exists()


def test_every_seed_of_a_retrained_experiment_is_a_whole_run(made, tmp_path):
    found = run("whole", tmp_path)
    logs = [load_json(tmp_path / "whole" / f"seed{seed}" / LOG) for seed in (0, 1)]
    assert found["seeds"] == 2 and logs[0]["vae"] != logs[1]["vae"]
    same = load_json(made[0] / "two" / "first" / LOG)  # the same configuration and seed
    assert (same["vae"], same["generations"]) == (logs[0]["vae"], logs[0]["generations"])


def test_fine_tuning_continues_the_same_seed_of_its_base_and_adds_its_budget(copy):
    before = state(copy)
    found = run("tuned", copy, seeds=[1])
    assert run("tuned", copy, seeds=[1]) == found
    assert {path.name for path in (copy / "tuned").iterdir()} == {"seed1"}
    after = state(copy)
    assert all(after[path] == told for path, told in before.items())
    records = [load_json(copy / name / "seed1" / RECORD) for name in ("two", "tuned")]
    assert records[1]["earlier"] == records[0]
    spent = [total_budget(record)["episodes"] for record in records]
    assert spent[1] == spent[0] + 2 * 4 * 2 + 2


def test_fine_tuning_makes_the_missing_seed_of_its_base_first(copy):
    shutil.rmtree(copy / "two" / "seed1")
    run("tuned", copy, seeds=[1])
    assert (copy / "two" / "seed1" / EVALUATION).exists()


def test_what_is_there_is_not_done_again(made):
    folder, summaries = made
    before = state(folder)
    assert replicate("two", folder) == summaries["two"]
    assert state(folder) == before


@pytest.mark.parametrize("cause", ["lost", "of another controller"])
def test_an_evaluation_that_is_lost_or_of_another_controller_is_made_again(cause, made, copy):
    path = copy / "two" / "seed1" / EVALUATION
    whole = load_json(path)
    path.unlink() if cause == "lost" else save_json(path, whole | {"controller": cause})
    assert run("two", copy) == made[1]["two"]
    assert load_json(path)["controller"] == whole["controller"]


def test_an_interrupted_experiment_continues_to_the_same_result(made, tmp_path, interrupt_after):
    # In the first V, in the second one (6 + 4 updates are left of the first V and M), in driving.
    for updates in (3, 6 + 4 + 3):
        with interrupt_after(updates):
            run("two", tmp_path, seeds=[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "drive_group", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run("two", tmp_path, seeds=[0])
    run("two", tmp_path, seeds=[0])
    folders = [folder / "two" / "seed0" for folder in (tmp_path, made[0])]
    logs = [load_json(folder / LOG) for folder in folders]
    assert logs[0] == logs[1]
    driven = [load_json(folder / EVALUATION)["episodes"] for folder in folders]
    assert driven[0] == driven[1]


def interrupted(*given, **named):
    """In place of a function that drives."""
    raise KeyboardInterrupt


def test_components_and_first_controller_are_computed_once(made, tmp_path, capsys):
    for part in ("world", "first"):
        shutil.copytree(made[0] / "two" / part, tmp_path / "two" / part)
    for seed in (1, 0):  # in the other order than in `made`
        capsys.readouterr()
        run("two", tmp_path, seeds=[seed])
        assert ("components:" in capsys.readouterr().err) == (seed == 1)
        logs = [(folder / "two" / f"seed{seed}" / LOG) for folder in (tmp_path, made[0])]
        assert logs[0].read_bytes() == logs[1].read_bytes()


def test_components_of_a_seed_with_another_v_are_not_shared(made, copy):
    shutil.rmtree(copy / "two" / "seed1")
    for name in (VAE_FILE, COMPONENTS_FILE, START_FILE):
        (copy / "two" / "seed0" / name).write_bytes(b"of another training")
    run("two", copy, seeds=[1])
    logs = [folder / "two" / "seed1" / LOG for folder in (copy, made[0])]
    assert logs[0].read_bytes() == logs[1].read_bytes()


def test_finished_seeds_are_kept_in_the_tables(made, copy, tmp_path):
    data = tmp_path / "data"
    assert keep("one", copy, to=data) == [] and not data.exists()
    (copy / "two" / "seed0" / EVALUATION).unlink()
    assert keep("two", copy, to=data) == ["two-1"]
    for _ in range(2):  # with seed 0, and without a change
        assert keep("two", made[0], to=data) == ["two-0", "two-1"]
    runs = tables.read("runs", data)
    roles = runs.groupby("role")["seed"].apply(list).to_dict()
    assert roles == {"first_iteration": [0, 1], "world_model": [0, 1], "run": [0, 1]}
    returns = tables.returns_of(tables.episodes(data))["two"]
    assert returns.mean() == made[1]["two"]["mean"] and returns.shape == (2, 1)
    generations = tables.read("generations", data).groupby(["role", "seed"]).size()
    assert generations.tolist() == [2, 2, 4, 4]


def test_the_budget_of_a_run_counts_every_episode_that_was_driven_for_it(made, tmp_path):
    keep("two", made[0], to=tmp_path)
    runs = tables.read("runs", tmp_path)
    # 8 random episodes, 2 generations of 4 agents, 2 validation tracks; then 2 episodes of the
    # agent, 4 generations and 2 validations.
    total = 8 + 8 + 2 + 2 + 16 + 4
    own = runs[runs.role == "run"]
    assert own["total.episodes"].tolist() == [total] * 2
    assert own["total.agents"].tolist() == [8 + 16] * 2


def test_a_baseline_driver_is_an_experiment_like_any_other(tmp_path, monkeypatch):
    for module in (replication, tables):
        monkeypatch.setattr(module, "TRACKS", 2)
    found = {name: run(name, tmp_path) for name in BASELINE_DRIVERS}
    assert found["random_driver"]["mean"] != found["constant_driver"]["mean"]
    for name, summary in found.items():
        driven = load_json(tmp_path / name / "seed0" / EVALUATION)
        assert [episode["track"] for episode in driven["episodes"]] == [0, 1]
        assert driven["mean"] == summary["mean"] < 200
        assert replicate(name, tmp_path) == summary
        assert keep(name, tmp_path, to=tmp_path / "data") == [f"{name}-0"]
        for ask in (replicate, keep):
            with pytest.raises(ValueError, match="has no seeds"):
                ask(name, tmp_path, seeds=[0])


def test_the_time_of_an_experiment_is_that_of_all_that_it_builds_on():
    def minutes(name, *seeds):
        line = describe_time(name, seeds)
        assert line.startswith(f"{name}: about ")
        return int(line.split("about ")[1].split()[0])

    assert minutes("paper_frame") > minutes("paper_frame", 0) > 0
    assert minutes("fine_tuned_frame", 0) > minutes("two_iterations_frame", 0)
    assert minutes("constant_driver") < 5


def test_the_command_says_the_time_runs_a_seed_and_keeps_it(made, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(replication.keep, "__defaults__", (None, tmp_path / "data"))
    command = ["replicate", "two", "--out", str(made[0])]
    assert main([*command, "--seeds", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("two: about") and "1 seeds" in lines[-1]
    assert main([*command, "--keep"]) == 0
    assert capsys.readouterr().out.splitlines() == ["kept two-0", "kept two-1"]
    assert main(["replicate", "one", "--out", str(made[0]), "--keep"]) == 0
    assert "no seed is finished" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["papers"], "unknown experiment 'papers': choose one of paper_frame, "),
        (["one_iteration", "--seeds", "1", "7"], "experiment 'one_iteration' has no seed 7"),
        (["one_iteration", "--keep", "--scheduler", "tcp://a:1"], "--keep drives nothing"),
    ],
)
def test_an_unknown_experiment_or_seed_ends_in_one_line(options, message, tmp_path, capsys):
    assert main(["replicate", *options, "--out", str(tmp_path)]) == 2
    assert f"error: {message}" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_a_run_is_evaluated_on_the_test_tracks_with_gymnasium_s_renderer(made, copy, monkeypatch):
    asked, folder = [], copy / "two" / "seed0"
    (folder / EVALUATION).unlink()
    monkeypatch.setattr(
        replication, "evaluate", lambda *given, **named: asked.append((given, named)) or {}
    )
    replication.evaluate_run(folder, None)
    call = inspect.signature(evaluate).bind(*asked[0][0], **asked[0][1])
    call.apply_defaults()
    assert [call.arguments[name] for name in ("episodes", "first_track", "fast")] == [1, 0, False]
    assert call.arguments["unfinished"].parent == folder  # so that it can be continued
