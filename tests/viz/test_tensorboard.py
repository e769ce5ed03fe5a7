"""`train --tensorboard`: TensorBoard's own reader finds what the run has logged."""

import shutil
import sys

import pytest

from stad_lab.cli import main
from stad_lab.config import Config
from stad_lab.io.files import load_json
from stad_lab.io.weights import CONTROLLER_FILE, VAE_FILE, load_vae
from stad_lab.training.evolution import LOG
from stad_lab.training.pipeline import train

TRAIN = ["train", "quick", "--tensorboard", "--out"]


@pytest.fixture(scope="module")
def told(quick_run, tmp_path_factory):
    """A quick run whose C is evolved again, with TensorBoard: (folder, its reader)."""
    run = shutil.copytree(quick_run, tmp_path_factory.mktemp("told") / "run")
    (run / CONTROLLER_FILE).unlink()
    assert main([*TRAIN, str(run)]) == 0
    return run, events_of(run)


def events_of(run):
    """What TensorBoard reads of a run."""
    # This takes seconds.
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder, all_of_them = str(run / "tensorboard"), {"scalars": 0, "images": 0}
    return EventAccumulator(folder, size_guidance=all_of_them).Reload()


def test_losses_and_returns_are_those_of_the_run(told):
    run, events = told
    history = load_vae(run / VAE_FILE)[1]["history"]
    read = {entry.step: entry.value for entry in events.Scalars("vae/heldout/total")}
    assert read == pytest.approx({one["step"]: one["heldout"]["total"] for one in history})
    generations = load_json(run / LOG, kind="evolution")["generations"]
    read = [entry.value for entry in events.Scalars("controller/sigma")]
    assert read == pytest.approx([generation["sigma"] for generation in generations])
    assert {"mdn_rnn/train/total", "controller/mean", "controller/validation"} <= set(
        events.Tags()["scalars"]
    )


def test_a_training_that_is_refused_or_ends_with_the_dataset_erases_no_events(told):
    before = {path: path.stat().st_size for path in (told[0] / "tensorboard").rglob("*")}
    assert main([*TRAIN, str(told[0]), "--seed", "1"]) == 2
    assert main([*TRAIN, str(told[0]), "--until", "dataset"]) == 0
    assert {path: path.stat().st_size for path in before} == before


def test_the_film_is_an_animation(told):
    (image,) = told[1].Images("agent")
    assert image.encoded_image_string.startswith(b"GIF89a")


def test_the_projector_has_a_row_of_z_and_of_motion_for_each_frame(told):
    (tensors,) = (told[0] / "tensorboard").rglob("tensors.tsv")
    rows = tensors.read_text().splitlines()
    labels = tensors.with_name("metadata.tsv").read_text().splitlines()
    assert len(rows) == len(labels) - 1 > 50  # the labels have a heading
    assert {len(row.split("\t")) for row in rows} == {Config.preset("quick").vae.latent_size}


def test_a_second_call_writes_the_same_curves_once(told):
    run, events = told
    assert main([*TRAIN, str(run)]) == 0
    again = events_of(run)
    steps = [[one.step for one in each.Scalars("mdn_rnn/train/total")] for each in (events, again)]
    assert steps[0] == steps[1]


def test_without_the_option_nothing_is_watched(quick_run):
    assert not (quick_run / "tensorboard").exists()
    assert not train(Config.preset("quick"), quick_run, watch=None)


def test_a_folder_of_something_else_is_left_alone(tmp_path, capsys):
    (tmp_path / "tensorboard").mkdir()
    (tmp_path / "tensorboard" / "notes.txt").write_text("mine")
    assert main([*TRAIN, str(tmp_path)]) == 2
    assert "not of TensorBoard" in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == ["tensorboard", "notes.txt"]


def test_without_tensorboard_one_line_names_the_extra(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    assert main([*TRAIN, str(tmp_path / "run")]) == 2
    assert "pip install 'stad_lab[tensorboard]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
