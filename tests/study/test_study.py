"""A study: whole pipelines into the tables, kept in half precision, and repeated bit by bit."""

import dataclasses
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.config import TRACK_RANGES, Config, track_seeds
from stad_lab.evaluation import probe_run
from stad_lab.evaluation.trajectories import MOTION
from stad_lab.io.files import load_json, load_tensors
from stad_lab.io.weights import CONTROLLER_FILE, VAE_FILE, load_controller
from stad_lab.training.dataset import Dataset
from stad_lab.training.evolution import LOG, crc
from stad_lab.training.record import RECORD
from stad_study import networks, study, study_probe, tables
from stad_study.cli import main
from stad_study.networks import WORLD_MODEL_FILE, load_kept_agent
from stad_study.study import (
    SCORE,
    STUDIES,
    Study,
    evaluate_kept,
    final_controller,
    find_pipelines,
    run_study,
)
from stad_study.study_probe import probe_study

BRIEF = {"generations": 4, "max_frames": 30, "components": 8}
CONFIG = Config.preset("quick", vae={"steps": 8, "batch": 8}, mdn_rnn={"steps": 4}, evolution=BRIEF)
VARIANTS = ("frame", "input_output")
TINY = Study((0, 1), VARIANTS, config=CONFIG, tracks=range(1000, 1018), max_frames=40)


@pytest.fixture(scope="module", autouse=True)
def declared():
    """A tiny study, "tiny"."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STUDIES, "tiny", TINY)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of seed 0 of the tiny study, with its tables in `data`."""
    folder = tmp_path_factory.mktemp("study")
    run_study("tiny", folder, seeds=[0], to=folder / "data")
    return folder


def test_a_study_may_keep_no_networks(made, tmp_path, monkeypatch):
    monkeypatch.setitem(STUDIES, "tiny", dataclasses.replace(TINY, keeps_networks=False))
    pipeline, to = find_pipelines("tiny", [0])[0], tmp_path / "data"
    study.add_pipeline(pipeline, made / "tiny", to)
    assert study.recorded(pipeline, to) and not [*tmp_path.rglob("*.safetensors")]


def logs(folder):
    """The logs of CMA-ES of seed 0, by pipeline."""
    found = find_pipelines("tiny", [0])
    return {one: load_json(folder / "tiny" / one.name / LOG) for one in found}


def test_a_study_runs_whole_seeds_in_order():
    names = [one.name for one in find_pipelines("study1")]
    assert len(set(names)) == 96 and names[:2] == ["seed0/frame/z", "seed0/frame/z_h"]
    assert [name.split("/")[0] for name in names] == [
        f"seed{n}" for n in range(12) for _ in "8" * 8
    ]
    config = find_pipelines("study1", [3], ["seed3/output/z"])[0].config
    assert (config.variant, config.seed) == ("output", 3)
    assert (config.evolution.features, config.evolution.seed) == ("z", 3)
    assert STUDIES["study1"].tracks == range(1000, 1400)


def test_the_settings_of_a_study_are_those_that_its_runs_recorded():
    runs = tables.read_study("runs")
    for name in STUDIES:
        study.check_settings(name, runs)


def test_training_and_validation_never_drive_the_tracks_of_a_score():
    scored = {*range(100), *STUDIES["study1"].tracks}
    assert scored <= set(range(*TRACK_RANGES["test"]))
    for one in find_pipelines("study1", only=[f"seed{seed}/frame/z" for seed in range(12)]):
        config, driven = one.config, set()
        driven |= set(track_seeds("collect", config.data.episodes, config.seed))
        driven |= set(track_seeds("validate", config.evolution.validation_tracks))
        for generation in range(config.evolution.generations):
            numbers = generation, config.evolution.seed
            driven |= set(track_seeds("evolve", config.evolution.tracks, config.seed, *numbers))
        assert len(driven) > 900 and not driven & scored


def test_the_pipelines_of_a_seed_share_dataset_and_tracks_and_a_variant_shares_v_and_m(made):
    found = logs(made)
    assert len({log["vae"] for log in found.values()}) == 2
    assert len({log["mdn_rnn"] for log in found.values()}) == 2
    tracks = {str([entry["tracks"] for entry in log["generations"]]) for log in found.values()}
    assert len(tracks) == 1
    assert len({str(log["random"]) for log in found.values()}) == 1
    seen = [load_tensors(made / f"tiny/seed0/{one}" / VAE_FILE)[1]["dataset"] for one in VARIANTS]
    assert seen == [Dataset(made / "tiny/seed0/dataset").checksum] * 2
    controllers = [made / "tiny" / one.name / CONTROLLER_FILE for one in found]
    assert len({load_controller(file)[0].tobytes() for file in controllers}) == 4


def test_c_that_sees_z_has_no_weight_on_h(made):
    for name, sees in (("z", False), ("z_h", True)):
        agent = load_kept_agent(made / f"tiny/networks/seed0/frame/{name}.safetensors")
        weights = agent.parameters[:-3].reshape(3, -1)
        assert weights[:, :32].any() and weights[:, 32:].any() == sees


def test_the_score_is_of_the_final_averaged_mean_after_rounding(made):
    pipeline = find_pipelines("tiny", [0])[1]
    run = made / "tiny" / pipeline.name
    final, kept = final_controller(pipeline.config, run), run.parents[2] / "networks"
    agent = load_kept_agent(kept / f"{pipeline.name}.safetensors")
    assert (agent.parameters == final.astype(np.float16)).all() and (
        agent.parameters != final
    ).any()
    generations = load_json(run / LOG)["generations"]
    assert crc(final) == generations[-1]["validation"]["controller_checksum"]
    assert crc(final) != generations[1]["validation"]["controller_checksum"]
    tensors, _ = load_tensors(kept / "seed0/frame" / WORLD_MODEL_FILE)
    assert {str(one.dtype) for one in tensors.values()} == {"torch.float16"}
    assert {name.split(".")[1] for name in tensors} == {"encoder", "lstm"}
    score = load_json(run / SCORE)
    first = study.drive_tracks(agent, range(1000, 1016), limits={"max_frames": 40})
    assert first["episodes"] == score["episodes"][:16]


def test_every_pipeline_has_its_lines_in_the_tables(made):
    data = made / "data"
    episodes, generations, runs = (
        tables.read_study(name, data) for name in ("episodes", "generations", "runs")
    )
    assert len(episodes) == 4 * 18 and len(generations) == 4 * 4 and len(runs) == 4
    score = load_json(made / "tiny/seed0/frame/z" / SCORE)
    own = episodes.query("variant == 'frame' and features == 'z' and seed == 0")
    assert own["return"].tolist() == [one["return"] for one in score["episodes"]]
    driven = load_json(made / "tiny/seed0" / RECORD)["budget"]["random"]["episodes"]
    assert generations["episodes"].tolist() == [driven + count for count in (4, 10, 14, 20)] * 4
    assert runs["config.evolution.features"].tolist() == runs["features"].tolist()
    assert (runs.filter(like="seconds.") > 0).all(axis=None)
    copies = {path.name for path in (made / "networks/tiny/seed0/frame").iterdir()}
    assert copies == {WORLD_MODEL_FILE, "z.safetensors", "z_h.safetensors"}


def test_what_is_in_the_tables_is_not_run_and_what_is_in_the_folder_is_added(
    made, tmp_path, capsys
):
    run_study("tiny", tmp_path, seeds=[0], to=made / "data")
    assert capsys.readouterr().out == "tiny: 4 of 4 pipelines are done\n"
    assert not (tmp_path / "tiny").exists()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "train", lambda *given, **named: pytest.fail("it trained"))
        run_study("tiny", made, seeds=[0], to=tmp_path / "data")
    for name in ("episodes", "generations", "runs"):
        file = f"study_{name}.csv"
        assert (tmp_path / "data" / file).read_bytes() == (made / "data" / file).read_bytes()


def test_a_variant_that_lacks_a_pipeline_is_added_as_a_whole_because_both_share_v_and_m(
    made, tmp_path
):
    shutil.copytree(made / "data", tmp_path / "data")
    runs = tables.read_study("runs", tmp_path / "data")
    runs.loc[runs.variant == "frame", "kept_world_model"] = "of another processor"
    lacks = (runs.variant == "frame") & (runs.features == "z, h")
    tables.save("study_runs", runs[~lacks], tmp_path / "data")
    run_study("tiny", made, seeds=[0], to=tmp_path / "data")
    file = "study_runs.csv"
    assert (tmp_path / "data" / file).read_bytes() == (made / "data" / file).read_bytes()


def test_a_pipeline_repeated_by_name_is_bit_identical(made, tmp_path, capsys, monkeypatch):
    for name in ("replace_lines", "add_run"):
        monkeypatch.setattr(tables, name, lambda *given: pytest.fail("it changed the tables"))
    monkeypatch.setattr(study.run_study, "__defaults__", (None, None, None, made / "data"))
    command = ["replicate", "tiny", "--only", "seed0/input_output/z", "--out", str(tmp_path)]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert "seed0/input_output/z: bit-identical to the recorded one, all 18 returns" in told
    assert main(command) == 2  # it would compare the folder's own files
    assert "has the recorded run: give an empty folder with --out" in capsys.readouterr().err
    other = tables.read_study("episodes", made / "data")
    other["return"] += 0.1
    shutil.copytree(made / "data", tmp_path / "data")
    tables.save("study_episodes", other, tmp_path / "data")
    found = study.compare_pipeline(
        find_pipelines("tiny", [0])[2], tmp_path / "tiny", tmp_path / "data"
    )
    assert found.startswith("differs in 18 of 18 returns; recorded on ")


def test_a_pipeline_that_is_killed_in_driving_continues_to_the_same_score(made, tmp_path):
    def interrupted(*given, **named):
        raise KeyboardInterrupt

    for module, name in ((study, "drive_group"), (study, "save_json")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, name, interrupted)
            with pytest.raises(KeyboardInterrupt):
                run_study("tiny", tmp_path, only=["seed0/frame/z"], to=tmp_path / "data")
    run_study("tiny", tmp_path, only=["seed0/frame/z"], to=tmp_path / "data")
    scores = [load_json(one / "tiny/seed0/frame/z" / SCORE) for one in (tmp_path, made)]
    assert scores[0]["episodes"] == scores[1]["episodes"]


def test_kept_agents_are_driven_on_any_tracks_by_one_command(made, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluate_kept, "__defaults__", (None, None, made / "networks", None, ()))
    command = ["evaluate", "tiny", "--first-track", "5000", "--episodes", "2"]
    assert main([*command, "--only", "seed0/frame/z", "--json", str(tmp_path / "found.json")]) == 0
    assert capsys.readouterr().out.startswith("seed0/frame/z: mean return ")
    agents = load_json(tmp_path / "found.json")["agents"]
    assert [one["track"] for one in agents["seed0/frame/z"]["episodes"]] == [5000, 5001]
    resumed = [*command, "--only", "seed0/frame/z", "seed0/frame/z_h"]
    assert main([*resumed, "--json", str(tmp_path / "found.json")]) == 0
    assert capsys.readouterr().out.count("mean return") == 1  # of the agent that was missing
    assert set(load_json(tmp_path / "found.json")["agents"]) == {"seed0/frame/z", "seed0/frame/z_h"}
    other = ["evaluate", "tiny", "--first-track", "5001", "--episodes", "2", "--only"]
    assert main([*other, "seed0/frame/z", "--json", str(tmp_path / "found.json")]) == 2
    assert "holds another study, or other tracks" in capsys.readouterr().err
    (tmp_path / "record.json").write_text("{}")
    assert main([*command, "--json", str(tmp_path / "record.json")]) == 2
    assert "name of a run's own file" in capsys.readouterr().err
    assert main([*command, "--seeds", "1"]) == 2
    assert "make them with `python -m stad_study replicate tiny --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["study1", "--seeds", "12"], "study 'study1' has no seed 12: it has 0 to 11"),
        (["study1", "--only", "seed0/frame"], "study 'study1' has no run 'seed0/frame'"),
        (["study1", "--seeds", "1", "--only", "seed0/frame/z"], "has no run 'seed0/frame/z'"),
        (["no_bar_frame", "--only", "seed0/frame/z"], "'no_bar_frame' is no study"),
        (["study1", "--keep"], "--keep is for earlier experiments"),
    ],
)
def test_a_wrong_name_ends_in_one_line(options, message, tmp_path, capsys):
    assert main(["replicate", *options, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err and not any(tmp_path.iterdir())


def test_the_remaining_time_is_that_of_the_missing_stages(made):
    wanted = find_pipelines("tiny")
    runs = tables.read_study("runs", made / "data")
    seconds = runs[[f"seconds.{stage}" for stage in study.TIMED]].mean().to_numpy()
    hours = seconds @ [1, 2, 2, 4, 4] / 3600
    expected = f"4 of 8 pipelines are done, about {hours:.1f} hours are left"
    assert study.describe_progress("tiny", wanted, made / "data") == expected


def test_v_and_m_of_a_complete_seed_are_probed_once_with_untrained_controls(
    made, tmp_path, monkeypatch
):
    monkeypatch.setattr(probe_run, "AGENT_FRAMES", 100)
    monkeypatch.setattr(probe_run, "worker_threads", lambda count: ThreadPoolExecutor(1))
    shutil.copytree(made / "data", tmp_path / "data")
    given = {"to": tmp_path / "data", "networks": made / "networks", "trajectories": 12}
    assert probe_study("tiny", **given) == [0]
    table = tables.read_study("probe", tmp_path / "data")
    assert len(table) == 2 * 4 * 2 * len(MOTION)  # drivers, networks, features, quantities
    assert set(table.variant) == set(VARIANTS) and table.r2.nunique() == len(table)
    monkeypatch.setattr(study_probe, "random_trajectories", lambda *given: pytest.fail("again"))
    assert probe_study("tiny", **given) == []
    file = shutil.copytree(made / "networks", tmp_path / "networks") / "tiny/seed0/frame"
    (file / WORLD_MODEL_FILE).write_bytes(b"another")
    given["networks"] = tmp_path / "networks"
    with pytest.raises(ValueError, match="not the file of the recorded run"):
        probe_study("tiny", **given | {"to": made / "data"})


def test_a_variant_that_another_process_runs_is_left_to_it(made, tmp_path, capsys):
    held = "from stad_lab.io.files import locked; from pathlib import Path; import sys\n"
    held += "with locked(Path(sys.argv[1])): print(flush=True); sys.stdin.read()"
    shutil.copytree(made / "tiny", tmp_path / "tiny", ignore=shutil.ignore_patterns(".lock"))
    command = [sys.executable, "-c", held, str(tmp_path / "tiny/seed0/frame")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as other:
        other.stdout.readline()
        run_study("tiny", tmp_path, seeds=[0], to=tmp_path / "data")
        other.stdin.close()
    assert "seed0/frame: is run by another process" in capsys.readouterr().out
    assert set(tables.read_study("runs", tmp_path / "data").variant) == {"input_output"}


def test_without_the_kept_agents_an_installed_library_names_the_repository(tmp_path, monkeypatch):
    monkeypatch.setattr(networks, "NETWORKS", tmp_path / "networks")
    with pytest.raises(FileNotFoundError, match="clone the repository"):
        list(study.evaluate_kept("study1", [0], networks=tmp_path / "networks"))


def test_a_study_that_keeps_no_agents_says_so():
    with pytest.raises(ValueError, match="'study6_fast' keeps no agents"):
        list(study.evaluate_kept("study6_fast", [0]))
