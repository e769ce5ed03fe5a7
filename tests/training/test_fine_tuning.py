"""Fine-tuning: the same V and M, CMA-ES from the earlier C, and one budget for both runs."""

import itertools
import shlex
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.agent import PRETRAINED, load_agent
from stad_lab.cli import main
from stad_lab.evaluation.verify import verify
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import load_controller, load_world_model, save_controller
from stad_lab.training.evolution import LOG, generation_tracks
from stad_lab.training.fine_tuning import FINE_TUNING, begin, fine_tune, fine_tuning_config
from stad_lab.training.record import total_budget
from stad_lab.training.subspace import COMPONENTS_FILE, load_start, search_space
from stad_study.ship import ship

BRIEF = {"generations": 2, "population": 4, "tracks": 2, "validate_every": 1}
C = "controller.safetensors"


def brief_config(earlier, evolution=None, **changes):
    """The configuration of a brief fine-tuning of the run in `earlier`."""
    return fine_tuning_config(earlier, evolution=BRIEF | (evolution or {}), **changes)


def tune(earlier, folder, evolution=None, **changes):
    """A brief fine-tuning of the run in `earlier`; returns what `fine_tune` does."""
    with ThreadPoolExecutor(1) as executor:
        config = brief_config(earlier, evolution, **changes)
        return fine_tune(config, earlier, folder, executor)


def copy_run(run, folder):
    return shutil.copytree(run, folder, ignore=shutil.ignore_patterns("dataset"))


@pytest.fixture(scope="module")
def tuned(quick_run, tmp_path_factory):
    """The folder of a fine-tuning of the quick run."""
    folder = tmp_path_factory.mktemp("fine_tuning") / "run"
    assert tune(quick_run, folder)
    return folder


def test_it_begins_at_the_earlier_controller_on_the_same_world_model(tuned, quick_run):
    world_model = load_world_model(tuned)
    before, _ = load_controller(quick_run / C)
    assert world_model.checksums == load_world_model(quick_run).checksums
    assert np.array_equal(load_start(tuned / "start.safetensors", world_model), before)
    space = search_space(brief_config(quick_run), world_model, tuned)
    assert np.array_equal(space.expand(space.first), before)
    after, _ = load_controller(tuned / C)
    assert 0 < np.abs(after - before).max() < 1  # small steps away from it


def test_every_agent_drives_four_new_tracks_and_four_hard_earlier_ones(tuned, quick_run):
    for entry in load_json(tuned / LOG)["generations"]:
        assert np.shape(entry["returns"]) == (4, 2) and len(set(entry["tracks"])) == 2
    config, log = fine_tuning_config(quick_run), []
    for _ in range(6):
        tracks = generation_tracks(config, log)
        log.append({"tracks": tracks, "returns": [[900.0 - place for place in range(8)]]})
    assert log[5]["tracks"][:4] == log[0]["tracks"][:3:-1]  # the hardest that have rested
    assert not set(log[5]["tracks"][4:]) & {track for entry in log[:5] for track in entry["tracks"]}


def test_its_episodes_and_agents_are_added_to_those_of_the_earlier_run(tuned, quick_run):
    record, before = load_json(tuned / "record.json"), load_json(quick_run / "record.json")
    assert record["earlier"] == before
    own, first, both = record["budget"], total_budget(before), total_budget(record)
    assert both["agents"] == first["agents"] + 8 and own["random"]["episodes"] == 0
    assert both["episodes"] == first["episodes"] + 2 * 4 * 2 + 2 * 2
    driven = own["evolution"]["frames"] + own["validation"]["frames"]
    assert both["frames"] == first["frames"] + driven


def test_a_folder_with_another_v_and_m_is_refused(quick_run, tmp_path):
    earlier, folder = copy_run(quick_run, tmp_path / "earlier"), tmp_path / "run"
    shutil.copy(PRETRAINED / "input" / COMPONENTS_FILE, earlier)
    folder.mkdir()
    for part in ("vae", "mdn_rnn"):
        shutil.copy(PRETRAINED / "input_output" / f"{part}.safetensors", folder)
    config, before = brief_config(quick_run), sorted(folder.iterdir())
    with pytest.raises(ValueError, match=r"vae.safetensors is not that of .*: choose another"):
        begin(config, earlier, folder)
    assert sorted(folder.iterdir()) == before


def test_a_finished_run_is_not_fine_tuned_in_place(quick_run, tmp_path):
    run = copy_run(quick_run, tmp_path / "run")
    before = {path: path.read_bytes() for path in run.iterdir()}
    for earlier in (run, quick_run):
        with pytest.raises(ValueError, match="choose another folder"):
            tune(earlier, run)
    assert {path: path.read_bytes() for path in run.iterdir()} == before


def test_a_fine_tuning_that_is_made_longer_equals_a_long_one_bit_for_bit(
    tuned, quick_run, tmp_path
):
    assert tune(quick_run, tmp_path / "run", {"generations": 1})
    assert tune(quick_run, tmp_path / "run")
    for name in (C, "start.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tuned / name).read_bytes()
    assert load_json(tmp_path / "run" / LOG) == load_json(tuned / LOG)
    assert not tune(quick_run, tmp_path / "run")


def test_an_interrupted_copy_of_v_is_made_again(tuned, quick_run, tmp_path, monkeypatch):
    calls = itertools.count()

    def interrupt(_):
        if next(calls) == 0:  # in the middle of V
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("os.fsync", interrupt)
        tune(quick_run, tmp_path / "run")
    assert not (tmp_path / "run" / "vae.safetensors").exists()
    assert tune(quick_run, tmp_path / "run")
    assert (tmp_path / "run" / LOG).read_bytes() == (tuned / LOG).read_bytes()


def test_a_fine_tuned_run_can_be_verified_shipped_and_verified_again(tuned, tmp_path, monkeypatch):
    monkeypatch.setattr("stad_study.ship.PRETRAINED", tmp_path)
    shipped = ship(tuned, "tuned")
    assert shipped == tmp_path / "tuned"
    assert np.array_equal(load_agent(shipped).parameters, load_agent(tuned).parameters)
    for folder in (tuned, shipped):
        found = verify(folder)
        assert found["log of CMA-ES"] == "ok: 2 generations give the same mean"
        assert found["C"].startswith("ok")
        assert not any(outcome.startswith("FAILED") for outcome in found.values())


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"vae": {"width": 16}}, r"made with vae.width=8, now vae.width=16 is asked for"),
        ({"evolution": {"patience": 0}}, r"made with evolution.patience=100, now evolution.pat"),
        ({"depth": 3}, r"unknown setting 'depth'"),
    ],
)
def test_a_setting_that_fine_tuning_may_not_change_is_refused_before_anything_is_written(
    changes, error, quick_run, tmp_path
):
    with pytest.raises(ValueError, match=error):
        tune(quick_run, tmp_path / "run", **changes)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("missing", ["record.json", "vae.safetensors", C, LOG])
def test_a_run_that_lacks_a_file_is_refused_before_anything_is_written(
    missing, quick_run, tmp_path
):
    folder = copy_run(quick_run, tmp_path / "half")
    (folder / missing).unlink()
    lacks = "no trained agent named .*half" if missing == C else missing
    with pytest.raises(FileNotFoundError, match=lacks):
        tune(folder, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_unfinished_run_is_refused_before_anything_is_written(quick_run, tmp_path):
    folder = copy_run(quick_run, tmp_path / "half")
    log = load_json(folder / LOG)
    save_json(folder / LOG, log | {"generations": log["generations"][:2]})
    error = r"is not finished, with 2 of 4 generations: run its own command to the end"
    with pytest.raises(ValueError, match=error):
        tune(folder, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_fine_tuning_of_another_controller_is_not_taken_for_this_one(tuned, quick_run, tmp_path):
    other = copy_run(quick_run, tmp_path / "other")
    assert not tune(other, tuned)  # the same run in another place
    parameters, metadata = load_controller(other / C)
    del metadata["kind"]
    save_controller(other / C, parameters + 1, **metadata)
    with pytest.raises(ValueError, match=r"continues from another C than that of .*other"):
        tune(other, tuned)


def test_the_command_in_the_record_makes_the_same_fine_tuning(
    tuned, quick_run, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(FINE_TUNING, "evolution", FINE_TUNING["evolution"] | BRIEF)
    command = shlex.split(load_json(tuned / "record.json")["made_with"]["command"])
    assert command[:4] == ["python", "-m", "stad_lab", "fine-tune"]
    places = {"--run": str(quick_run), "--out": str(tmp_path / "run")}
    arguments = [places.get(*pair) for pair in zip(["", *command], command, strict=False)]
    for outcome in ("controller: done", "the fine-tuned run is there"):
        assert main(arguments[3:]) == 0
        assert outcome in capsys.readouterr().out
    assert (tmp_path / "run" / LOG).read_bytes() == (tuned / LOG).read_bytes()
