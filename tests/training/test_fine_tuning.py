"""A finish: the same V and M, a search from the C of before, and one budget for all of it."""

import itertools
import shlex
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.__main__ import main, read_changes
from stad_lab.agent import PRETRAINED, load_agent, load_controller, read_world_model
from stad_lab.config import Settings
from stad_lab.evaluation.verify import verify
from stad_lab.io.files import load_json, save_json
from stad_lab.replication import run as replication
from stad_lab.replication.experiments import ROWS, Row
from stad_lab.replication.tables import RECORDS, learning_curve, summarise_row
from stad_lab.training.evolution import LOG, generation_tracks
from stad_lab.training.fine_tuning import FINISH, begin_finish, finish, finish_settings
from stad_lab.training.pipeline import ship, total_budget
from stad_lab.training.subspace import load_start, search_space

VARIANT = "input_output"
BRIEF = {"generations": 2, "population": 4, "tracks": 2, "validate_every": 1}


def go(earlier, folder, **changes):
    """A brief finish of the run in `earlier`; returns what `finish` does."""
    with ThreadPoolExecutor(1) as executor:
        return finish(
            VARIANT, finish_settings(earlier, **BRIEF | changes), earlier, folder, executor
        )


@pytest.fixture(scope="module")
def finished(quick_run, tmp_path_factory):
    """The folder of a finish of the quick run."""
    folder = tmp_path_factory.mktemp("finish") / "run"
    assert go(quick_run, folder)
    return folder


def test_a_finish_begins_at_the_controller_of_before_on_the_same_world_model(finished, quick_run):
    world_model = read_world_model(finished, VARIANT)
    before, _ = load_controller(quick_run / "controller.safetensors", VARIANT)
    assert world_model.identities == read_world_model(quick_run, VARIANT).identities
    assert np.array_equal(load_start(finished / "start.safetensors", world_model), before)
    space = search_space(finish_settings(quick_run, **BRIEF), world_model, finished)
    assert np.array_equal(space.expand(space.first), before)
    after, _ = load_controller(finished / "controller.safetensors", VARIANT)
    assert 0 < np.abs(after - before).max() < 1  # small steps away from it


def test_every_agent_of_a_finish_drives_four_new_tracks_and_four_hard_ones_of_before(
    finished, quick_run
):
    generations = load_json(finished / LOG)["generations"]
    assert all(
        np.shape(entry["returns"]) == (4, 2) and len(set(entry["tracks"])) == 2
        for entry in generations
    )
    settings, log = finish_settings(quick_run), []
    for _ in range(6):
        tracks = generation_tracks(settings, log)
        log.append({"tracks": tracks, "returns": [[900.0 - place for place in range(8)]]})
    assert (
        log[5]["tracks"][:4] == log[0]["tracks"][:3:-1]
    )  # the hardest ones that do not rest any more
    assert not set(log[5]["tracks"][4:]) & {track for entry in log[:5] for track in entry["tracks"]}


def test_a_finish_adds_its_episodes_and_agents_to_those_of_before(finished, quick_run):
    record, before = load_json(finished / "record.json"), load_json(quick_run / "record.json")
    assert record["earlier"] == before
    mine, first, both = record["budget"], total_budget(before), total_budget(record)
    assert both["agents"] == first["agents"] + 8 and mine["random"]["episodes"] == 0
    assert both["episodes"] == first["episodes"] + 2 * 4 * 2 + 2 * 2
    assert (
        both["frames"]
        == first["frames"] + mine["evolution"]["frames"] + mine["validation"]["frames"]
    )


def test_a_finish_in_a_folder_with_another_v_and_m_is_refused(quick_run, tmp_path):
    for part in ("autoencoder", "mdn_rnn"):
        shutil.copy(PRETRAINED / VARIANT / f"{part}.safetensors", tmp_path)
    with pytest.raises(
        ValueError,
        match=r"controller.safetensors was made with another autoencoder .* C of one run",
    ):
        begin_finish(VARIANT, quick_run, tmp_path)


def test_a_finish_goes_on_where_it_stopped_and_ends_with_the_same_bits(
    finished, quick_run, tmp_path
):
    assert go(quick_run, tmp_path / "run", generations=1)
    assert go(quick_run, tmp_path / "run")
    for name in ("controller.safetensors", "start.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (finished / name).read_bytes()
    assert load_json(tmp_path / "run" / LOG) == load_json(finished / LOG)
    assert not go(quick_run, tmp_path / "run")


def test_a_finish_is_verified_and_shipped_like_a_second_round(finished, tmp_path):
    shipped = ship(VARIANT, finished, tmp_path)
    assert np.array_equal(
        load_agent(VARIANT, shipped).parameters, load_agent(VARIANT, finished).parameters
    )
    for folder in (finished, shipped):
        found = verify(folder)
        assert found["log of CMA-ES"] == "ok: 2 generations lead to the same mean" and found[
            "C"
        ].startswith("ok")
        assert not any(outcome.startswith("FAILED") for outcome in found.values())


def test_a_copy_that_was_cut_off_is_made_again(finished, quick_run, tmp_path, monkeypatch):
    calls = itertools.count()

    def interrupt(_):
        if next(calls) == 2:  # after the record's file and folder: in the middle of V
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("os.fsync", interrupt)
        go(quick_run, tmp_path / "run")
    assert (tmp_path / "run" / "record.json").exists()
    assert not (tmp_path / "run" / "autoencoder.safetensors").exists()
    assert go(quick_run, tmp_path / "run")
    assert (tmp_path / "run" / LOG).read_bytes() == (finished / LOG).read_bytes()


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        (
            {"width": 16},
            r"width=16, but the run in .* has 8: leave it so, a finish may change generations, population",
        ),
        ({"patience": 0}, r"patience=0, but the run in .* has 100: leave it so"),
        ({"depth": 3}, r"unknown setting 'depth'"),
    ],
)
def test_other_settings_than_those_of_a_search_are_refused_before_anything_is_written(
    changes, error, quick_run, tmp_path
):
    with pytest.raises(ValueError, match=error):
        go(quick_run, tmp_path / "run", **changes)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "missing", ["record.json", "autoencoder.safetensors", "controller.safetensors", LOG]
)
def test_a_run_that_lacks_a_file_is_refused_before_anything_is_written(
    missing, quick_run, tmp_path
):
    folder = shutil.copytree(
        quick_run, tmp_path / "half", ignore=shutil.ignore_patterns("rollouts")
    )
    (folder / missing).unlink()
    with pytest.raises(FileNotFoundError, match=missing):
        go(folder, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_driver_that_has_no_controller_is_refused():
    with pytest.raises(ValueError, match="is of gentle_driver, which has no C to go on from"):
        finish_settings(RECORDS / "gentle_driver" / "seed0")


def test_a_run_that_is_not_at_its_end_is_refused_before_anything_is_written(quick_run, tmp_path):
    folder = shutil.copytree(
        quick_run, tmp_path / "half", ignore=shutil.ignore_patterns("rollouts")
    )
    log = load_json(folder / LOG)
    save_json(folder / LOG, log | {"generations": log["generations"][:2]})
    with pytest.raises(
        ValueError,
        match=r"is not at its end, with 2 of 4 generations: run its own command to the end",
    ):
        go(folder, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_finish_of_another_run_is_not_taken_for_this_one(finished, quick_run, tmp_path):
    other = shutil.copytree(
        quick_run, tmp_path / "other", ignore=shutil.ignore_patterns("rollouts")
    )
    record = load_json(other / "record.json")
    save_json(other / "record.json", record | {"seconds": {}})  # the same one, looked at again
    assert not go(other, finished)
    save_json(
        other / "record.json",
        record | {"budget": record["budget"] | {"random": {"episodes": 9, "frames": 9}}},
    )
    with pytest.raises(
        ValueError,
        match=r"holds a run that does not go on from the one given as it is now: choose another",
    ):
        go(other, finished)


def test_the_command_finishes_a_run_and_its_record_says_how(finished, quick_run, tmp_path, capsys):
    made_with = load_json(finished / "record.json")["made_with"]
    said = shlex.split(made_with["command"])
    places = {"--path": quick_run, "--out": tmp_path / "run"}
    arguments = [
        str(places.get(before, word)) for before, word in zip(["", *said], said, strict=False)
    ]
    assert arguments[:4] == ["python", "-m", "stad_lab", "finish"]
    changes = read_changes(
        [word for before, word in zip(["", *said], said, strict=False) if before == "--set"]
    )
    assert changes == {name: BRIEF[name] for name in BRIEF if BRIEF[name] != FINISH[name]}
    for outcome in ("controller: done", "the finish is there"):
        assert main(arguments[3:]) == 0
        assert outcome in capsys.readouterr().out
    assert (tmp_path / "run" / LOG).read_bytes() == (finished / LOG).read_bytes()


def test_a_row_of_finishes_goes_on_from_the_seeds_of_its_base(
    evaluate_briefly, monkeypatch, tmp_path
):
    settings = Settings.preset("quick", processes=1, generations=2, v_steps=8, m_steps=4)
    last = Settings.from_dict(settings.as_dict() | FINISH | BRIEF | {"validate_every": 2})
    monkeypatch.setitem(ROWS, "first", Row("input", "before", settings, seeds=(0, 1)))
    monkeypatch.setitem(ROWS, "last", Row("input", "after", last, seeds=(0, 1), base="first"))
    evaluate_briefly(monkeypatch)
    with ThreadPoolExecutor(1) as executor:
        found = replication.replicate("last", tmp_path, executor, seeds=[1])
        assert (
            not (tmp_path / "first" / "seed0").exists() and (tmp_path / "first" / "seed1").exists()
        )
        before = (tmp_path / "first" / "seed1" / LOG).stat().st_mtime_ns
        assert replication.replicate("last", tmp_path, executor, seeds=[1]) == found
    assert (tmp_path / "first" / "seed1" / LOG).stat().st_mtime_ns == before
    log = load_json(tmp_path / "last" / "seed1" / LOG)
    assert log["settings"]["evolution_seed"] == 1 and log["settings"]["tracks"] == 2
    base = summarise_row([tmp_path / "first" / "seed1"])
    assert (
        found["agents"] == base["agents"] + 2 * 4
        and found["episodes"] == base["episodes"] + 2 * 4 * 2 + 2
    )
    episodes, scores = learning_curve(tmp_path / "last" / "seed1")
    assert episodes.tolist() == [found["episodes"]] and len(scores) == 1
