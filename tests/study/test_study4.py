"""Study 4: whole runs of three stages, of which the best by validation is kept."""

import dataclasses
import shutil

import numpy as np
import pandas
import pytest

from stad_lab.agent import load_agent
from stad_lab.config import VARIANTS, Config
from stad_lab.io.files import load_json, save_json
from stad_lab.training.fine_tuning import FINE_TUNING
from stad_lab.training.record import RECORD, processor
from stad_study import study4, tables
from stad_study.cli import main
from stad_study.experiments import EXPERIMENTS
from stad_study.study import STUDIES, drive_tracks
from stad_study.study4 import STAGES, Run, add_run, find_runs, run_study4

BRIEF = {"generations": 2, "validate_every": 1, "max_frames": 20}
FIRST = Config.preset("quick", vae={"steps": 8, "batch": 8}, mdn_rnn={"steps": 4}, evolution=BRIEF)
FIRST = FIRST.replace(variant="frame", data={"crop_bar": False})
SECOND = FIRST.replace(data={"agent_episodes": 2})
TUNED = SECOND.replace(evolution={"generations": 2, "population": 4, "tracks": 2, "sigma": 0.02})
RUN = Run(400, "frame")


@pytest.fixture(scope="module", autouse=True)
def brief():
    """The study with stages and scores of seconds."""
    two, tuned = EXPERIMENTS["two_iterations_frame"], EXPERIMENTS["fine_tuned_frame"]
    with pytest.MonkeyPatch.context() as patch:
        first = dataclasses.replace(two, first=FIRST, config=SECOND)
        patch.setitem(EXPERIMENTS, "two_iterations_frame", first)
        patch.setitem(EXPERIMENTS, "fine_tuned_frame", dataclasses.replace(tuned, config=TUNED))
        patch.setattr(study4, "VALIDATION", 2)
        patch.setattr(study4, "TRACKS", range(6000, 6003))
        short = dataclasses.replace(STUDIES["study1"], max_frames=40)
        patch.setitem(STUDIES, "study1", short)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a finished run and its tables."""
    folder = tmp_path_factory.mktemp("study4")
    run_study4(folder, only=[RUN.name], to=folder / "data")
    return folder


def test_a_run_is_two_iterations_and_a_fine_tuning_with_the_indicator_bar():
    configs = Run(401, "input_output").configs
    assert list(configs) == ["first", "second", "tuned"]
    assert {(one.variant, one.seed, one.evolution.seed) for one in configs.values()} == {
        ("input_output", 401, 401)
    }
    assert not any(one.data.crop_bar for one in configs.values())
    assert [one.data.agent_episodes for one in configs.values()] == [0, 110, 110]
    assert configs["tuned"].evolution.tracks == FINE_TUNING["evolution"]["tracks"]
    names = [run.name for run in find_runs()]
    assert len(names) == 12 and names[:4] == [f"seed400/{one}" for one in VARIANTS]


def test_the_score_is_of_the_agent_as_it_is_kept(made):
    line = study4.recorded(RUN, made / "data")
    returns = tables.read("study4_returns", made / "data").set_index(tables.AGENT).loc[tuple(RUN)]
    assert list(returns.index) == ["6000", "6001", "6002"]
    assert line["mean"] == pytest.approx(returns.mean(), abs=0.01)
    kept, run = load_agent(made / "networks/study4/frame"), made / "study4" / RUN.name
    assert np.array_equal(kept.parameters, load_agent(run / "agent").parameters)
    assert line["validation"] == load_json(run / "tuned/evolution.json")["best"]["validation"]
    assert line["agents"] == 3 * 2 * 4


def test_a_run_stopped_in_every_stage_goes_on_and_gives_the_same_agent(
    made, tmp_path, interrupt_after, monkeypatch
):
    def run():
        run_study4(tmp_path, only=[RUN.name], to=tmp_path / "data")

    for updates in (4, 5 + 2, 3 + 4, 5 + 2):  # in V and M of the first iteration and the second
        with interrupt_after(updates):
            run()
    for step in ("fine_tune", "copy_in_half", "score_agent", "add_run"):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(study4, step, stop)
            run()
    run()
    was, now = (study4.recorded(RUN, folder / "data") for folder in (made, tmp_path))
    same = ("mean", "validation", "generation", "episodes", "frames", "controller")
    assert [was[name] for name in same] == [now[name] for name in same]


def stop(*_, **__):
    """Stop, as Ctrl-C does."""
    raise KeyboardInterrupt


def test_the_line_of_a_run_says_what_each_stage_and_the_score_were_made_with(made):
    line, here = study4.recorded(RUN, made / "data"), processor()
    stages = [f"processors.{stage}" for stage in ("dataset", *STAGES)]
    assert {line[one] for one in ("score.processor", "world_model.processor", *stages)} == {here}
    assert line["world_model.trained_on"] == "cpu" and line["score.numba"]


def test_a_stage_that_went_on_elsewhere_names_both_processors(made, tmp_path):
    seed = shutil.copytree(made / "study4/seed400", tmp_path / "seed400")
    record = load_json(seed / "frame/tuned" / RECORD)
    record["continued_with"] = [record["made_with"] | {"processor": "another"}]
    save_json(seed / "frame/tuned" / RECORD, record)
    line = study4.describe_run(seed / "frame", load_json(seed / "frame/score.json"))
    assert line["processors.tuned"] == f"{processor()}; another"
    assert line["processors.second"] == processor()


def test_a_run_that_fails_is_named_at_the_end_and_the_others_are_done(tmp_path, capsys):
    folder = tmp_path / "study4" / RUN.name / "first"
    folder.mkdir(parents=True)
    (folder / "record.json").write_text("{")
    with pytest.raises(ValueError, match="seed400/frame: not finished, for the reasons above"):
        run_study4(tmp_path, only=[RUN.name, "seed401/frame"], to=tmp_path / "data")
    told = capsys.readouterr().out
    assert "seed401/frame: is finished and in the tables" in told and "mean return" not in told
    assert "record.json" in told
    assert len(tables.read("study4_runs", tmp_path / "data")) == 1


def test_a_recorded_run_is_repeated_in_an_empty_folder_alone(made, tmp_path, capsys):
    with pytest.raises(ValueError, match="has the recorded run: give an empty folder"):
        run_study4(made, only=[RUN.name], to=made / "data")
    run_study4(tmp_path, only=[RUN.name], to=made / "data")
    mean = study4.recorded(RUN, made / "data")["mean"]
    assert f"mean return {mean:.1f}, recorded {mean:.1f}" in capsys.readouterr().out


def test_a_run_that_came_from_another_folder_meanwhile_is_not_replaced(made):
    before = tables.read("study4_runs", made / "data")
    with pytest.raises(ValueError, match="from another folder: nothing was added"):
        add_run(RUN, made / "study4", made / "data")
    assert tables.read("study4_runs", made / "data").equals(before)


def test_of_a_variant_the_agent_with_the_best_validation_is_kept(made, tmp_path):
    table = tables.read("study4_runs", made / "data")
    kept = tmp_path / "networks/study4/frame/controller.safetensors"
    for change, is_kept in ((-1.0, True), (1.0, False)):
        other = table.assign(seed=401, validation=table["validation"] + change)
        tables.save("study4_runs", other, tmp_path / "data")
        kept.unlink(missing_ok=True)
        add_run(RUN, made / "study4", tmp_path / "data")
        assert kept.exists() == is_kept
        assert len(tables.read("study4_runs", tmp_path / "data")) == 2


def test_after_the_last_run_the_shipped_agents_drive_on_the_same_tracks_once(
    made, tmp_path, monkeypatch
):
    folder, tmp_path = tmp_path, tmp_path / "data"
    for variant in VARIANTS:
        kept = folder / "networks/study4" / variant
        shutil.copytree(made / "networks/study4/frame", kept)
    line = tables.read("study4_runs", made / "data")
    lines = [line.assign(**run._asdict()) for run in find_runs()]
    tables.save("study4_runs", pandas.concat(lines[:-1]), tmp_path)
    run_study4(tmp_path, seeds=[400], to=tmp_path)
    assert not (tmp_path / "study4_shipped.csv").exists()  # a run is missing
    tables.save("study4_runs", pandas.concat(lines), tmp_path)
    run_study4(tmp_path, to=tmp_path)
    shipped = tables.read("study4_shipped", tmp_path).set_index("variant")
    assert set(shipped.index) == set(VARIANTS)
    for variant in VARIANTS:
        driven = drive_tracks(load_agent(variant), range(6000, 6003), 1, limits={"max_frames": 40})
        returns = [round(one["return"], 2) for one in driven["episodes"]]
        assert shipped.loc[variant, ["6000", "6001", "6002"]].tolist() == returns
    failures = tables.read("study4_failures", tmp_path).set_index(["variant", "track"])
    kept = study4.recorded(RUN, tmp_path), tables.read("study4_returns", made / "data")
    assert kept[0]["below_800"] == 1  # in 40 frames nobody earns more
    assert set(failures.index) == {(one, t) for one in VARIANTS for t in (6000, 6001, 6002)}
    found = failures.loc["frame", "points"].tolist()
    assert found == pytest.approx(kept[1][["6000", "6001", "6002"]].iloc[0].tolist(), abs=0.06)
    tables.save("study4_shipped", shipped.assign(controller="older").reset_index(), tmp_path)
    listed = tables.read("study4_failures", tmp_path)
    tables.save("study4_failures", listed[listed["variant"] != "frame"], tmp_path)
    run_study4(tmp_path, to=tmp_path)
    assert set(tables.read("study4_shipped", tmp_path)["controller"]) == {"older"}
    assert len(tables.read("study4_failures", tmp_path)) == len(listed)  # the missing ones
    monkeypatch.setattr(study4, "find_failures", stop)
    run_study4(tmp_path, to=tmp_path)


def test_bad_names_and_options_are_refused_in_one_line(tmp_path, capsys):
    for options, expected in (
        (["--only", "seed7/frame"], "study 'study4' has no run 'seed7/frame'"),
        (["--keep"], "study4 takes neither --keep nor --scheduler"),
    ):
        assert main(["replicate", "study4", "--out", str(tmp_path), *options]) == 2
        assert expected in capsys.readouterr().err
