"""The command line: the same command continues, help helps, and every mistake ends in one line."""

import importlib.metadata
import io
import re
import shlex
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from stad_course import cli as course
from stad_lab import cli, command_line
from stad_lab.cli import main, parse
from stad_lab.config import PRESETS, VARIANTS, Config, fields_of
from stad_lab.io.files import load_json, load_tensors, save_json, save_tensors
from stad_lab.io.weights import (
    load_vae,
    load_world_model,
    save_controller,
    save_mdn_rnn,
    save_vae,
)
from stad_lab.io.workers import TaskError
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training.fine_tuning import fine_tuning_config
from stad_lab.training.pipeline import STAGES
from stad_lab.training.record import command_of, fine_tuning_command
from stad_study import cli as study

QUICK = Config.preset("quick")


@pytest.fixture
def run(quick_run, tmp_path):
    """A copy of the quick run that a test may damage."""
    return shutil.copytree(quick_run, tmp_path / "run")


def states(folder):
    """Bytes and time of the last change of every file under a folder."""
    return {
        path.relative_to(folder).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def call(*arguments):
    """Run a command in this process; returns the exit status."""
    return main(list(map(str, arguments)))


def evaluate_quickly(source):
    """The arguments of a short evaluation."""
    return "evaluate", "--agent", source, "--fast", "--episodes", 1


def train_quickly(folder, *options):
    """The arguments of the command that made the quick run."""
    return "train", "quick", "--out", folder, *options


def the_error(capsys, *arguments):
    """The one line that a command prints before it ends with status 2."""
    capsys.readouterr()
    assert call(*arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


def help_of(capsys, *arguments, program=cli):
    """What a command prints with --help, without its frame, on one line."""
    with pytest.raises(SystemExit) as ended:
        program.main([*arguments, "--help"])
    assert not ended.value.code
    return " ".join(re.sub(r"[─│╭╮╰╯]", "", capsys.readouterr().out).split())


# What a run leaves, and what a second call does


def test_the_quick_run_takes_less_than_a_minute(quick_training):
    assert quick_training[2] < 60


def test_a_run_leaves_weights_log_and_record(quick_training):
    folder, process, _ = quick_training
    assert all(f"{stage}: done" in process.stdout for stage in STAGES)
    names = sorted(file.stem for file in folder.glob("*.safetensors"))
    assert names == ["controller", "mdn_rnn", "vae"]
    record = load_json(folder / "record.json", kind="record")
    assert record["variant"] == "input_output"
    assert Config.from_dict(record["config"]) == QUICK
    assert set(record["seconds"]) == set(STAGES)
    assert record["made_with"]["torch"] == importlib.metadata.version("torch")
    assert record["budget"]["random"] == {"episodes": 8, "frames": 8 * 60}
    assert record["budget"]["agents"] == record["budget"]["evolution"]["episodes"] == 4 * 4
    assert record["budget"]["validation"]["episodes"] == 2 * 2


def test_the_second_call_of_a_command_does_nothing_and_says_so(run, capsys):
    before = states(run)
    assert call(*train_quickly(run)) == 0
    told = capsys.readouterr().out
    assert f"everything up to controller is there in {run}: nothing to do" in told
    assert told.count("already there, nothing to do") == 4
    assert states(run) == before


def test_a_lost_budget_is_counted_again(run):
    whole = load_json(run / "record.json")
    save_json(run / "record.json", whole | {"budget": {"random": whole["budget"]["random"]}})
    for _ in range(2):
        assert call(*train_quickly(run)) == 0
        assert load_json(run / "record.json") == whole


def test_until_stops_after_a_stage_and_an_option_changes_a_field(tmp_path, capsys):
    changed = "--variant frame --vae.stride 2 --vae.kl-weight .5 --data.episodes 2"
    options = f"{changed} --data.no-crop-bar --until dataset"
    assert call(*train_quickly(tmp_path, *options.split())) == 0
    assert "dataset: done" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", "dataset", "record.json"]
    found = Config.from_dict(load_json(tmp_path / "record.json")["config"])
    data = {"episodes": 2, "crop_bar": False}
    vae = {"stride": 2, "kl_weight": 0.5}
    assert found == Config.preset("quick", variant="frame", data=data, vae=vae)


def test_a_new_run_with_a_dataset_that_is_there_has_a_record(tmp_path, capsys):
    shared = ["--until", "dataset", "--dataset", str(tmp_path / "shared")]
    for run in ("first", "second"):
        assert call(*train_quickly(tmp_path / run, *shared, "--data.episodes", "2")) == 0
    assert "dataset: already there" in capsys.readouterr().out
    assert load_json(tmp_path / "second/record.json")["config"]["data"]["episodes"] == 2


def test_a_start_that_was_refused_may_be_made_again_with_other_settings(
    tmp_path, monkeypatch, capsys
):
    command = train_quickly(tmp_path, "--until", "dataset")
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=1000))
    assert "collect fewer or shorter episodes" in the_error(capsys, *command)
    monkeypatch.undo()
    assert call(*command, "--data.episodes", 2) == 0
    assert load_json(tmp_path / "record.json")["config"]["data"]["episodes"] == 2
    assert "choose another folder" in the_error(capsys, *command)  # there is something to lose


def test_another_setting_of_c_leaves_v_and_m_valid(run):
    for name in ("evolution.json", "controller.safetensors"):
        (run / name).unlink()
    before = states(run)
    assert call(*train_quickly(run, "--evolution.sigma", 0.2, "--until", "mdn_rnn")) == 0
    after = states(run)
    assert [name for name in before if after[name] != before[name]] == ["record.json"]


def test_a_record_without_a_field_that_was_added_later_is_continued(run):
    def forget(values):
        del values["evolution"]["replay_share"]

    for name, part in (("record.json", "config"), ("evolution.json", None)):
        content = load_json(run / name)
        forget(content[part] if part else content)
        save_json(run / name, content)
    assert call(*train_quickly(run)) == 0


@pytest.mark.parametrize("preset", PRESETS)
def test_the_command_in_a_record_asks_for_the_configuration_of_that_record(monkeypatch, preset):
    changes = {"data": {"crop_bar": False}, "vae": {"stride": 2}, "evolution": {"features": "z"}}
    config = Config.preset(preset, variant="input", **changes)
    found = []
    monkeypatch.setattr(
        "stad_lab.training.pipeline.train", lambda *given: found.append(given[0]) or True
    )
    assert main(shlex.split(command_of(config))[3:]) == 0
    assert found == [config]


# Help


@pytest.mark.parametrize(
    ("program", "command"),
    [(one, name) for one in (cli, study, course) for name in one.COMMANDS],
)
def test_help_has_a_sentence_for_every_option_of_a_command(program, command, capsys):
    text = help_of(capsys, command, program=program)
    options = re.findall(r"(?<![\w-])--[\w.-]+", text)
    short = ("doctor", "claims", "verify", "ship", "kit", "check", "commit")
    assert command in short or len(options) > 2
    for option, following in re.findall(
        r"(--[a-z][\w.-]+) (?:[^(\s]\S* )?(.*?)(?= --[a-z]|$)", text
    ):
        sentence = re.split(r"\((?:default|required)", following)[0]
        assert re.search(r"[a-z]{3}", sentence), option


def test_help_of_train_names_every_field_with_its_sentence_and_default(capsys):
    text = help_of(capsys, "train", "paper")
    for name, _, value in fields_of(PRESETS["paper"]):
        option = f"--{name.replace('_', '-')}"
        assert option in text or option.replace("crop-bar", "no-crop-bar") in text
        option = option.replace("crop-bar", "no-crop-bar")  # the last of the two names
        told = text.rpartition(f"{option} ")[2].partition(" --")[0]
        assert str(value) in told.partition("(default: ")[2]
    assert "Weight of the KL term beside the squared error." in text


def test_the_first_help_names_every_command(capsys):
    text = help_of(capsys)
    assert [command for command in cli.COMMANDS if command not in text] == []


# Every option reaches what it is for


def test_the_options_of_train_reach_the_pipeline(monkeypatch):
    told = []
    monkeypatch.setattr("stad_lab.training.pipeline.train", lambda *given: told.append(given))
    options = "--variant input --dataset shared --earlier first --until mdn_rnn"
    assert call(*train_quickly("run", *options.split())) == 0
    config = QUICK.replace(variant="input")
    assert told == [(config, Path("run"), "shared", "mdn_rnn", None, "first", None)]


def test_the_options_of_fine_tune_reach_it(monkeypatch, quick_run):
    told = []
    monkeypatch.setattr(
        "stad_lab.training.fine_tuning.fine_tune", lambda *given: told.append(given)
    )
    options = "--generations 5 --sigma .01 --seed 3 --validation-tracks 9"
    others = "--processes 1 --out runs/tuned"
    assert call("fine-tune", "--run", quick_run, *options.split(), *others.split()) == 0
    ((config, earlier, folder, executor),) = told
    evolution = config.evolution
    assert (evolution.generations, evolution.sigma, evolution.seed) == (5, 0.01, 3)
    assert evolution.validation_tracks == 9
    assert (config.processes, earlier, folder) == (1, quick_run, Path("runs/tuned"))
    assert executor is None


def test_the_recorded_command_of_a_fine_tuning_makes_the_same_one(monkeypatch, quick_run):
    told = []
    monkeypatch.setattr(
        "stad_lab.training.fine_tuning.fine_tune", lambda *given: told.append(given)
    )
    own = {"generations": 10, "sigma": 0.03, "seed": 4, "validation_tracks": 12}
    config = fine_tuning_config(quick_run, evolution=own)
    command = fine_tuning_command(config).replace("--run ...", f"--run {quick_run}")
    assert call(*command.replace("...", "runs/tuned").split()[3:]) == 0
    assert told[0][0] == config


def test_a_film_is_a_moving_picture(quick_run, tmp_path, capsys):
    file = tmp_path / "drive.gif"
    shown = "--first", 20, "--frames", 12
    assert call("film", "--agent", quick_run, "--out", file, *shown) == 0
    assert f"filmed to {file}" in capsys.readouterr().out
    with Image.open(file) as film:
        assert film.format.lower() == file.suffix[1:]
        pictures = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    assert len(pictures) == 4  # every third frame
    assert not np.array_equal(pictures[0], pictures[-1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--track", "-1"], "track=-1: expected"),
        (["--first", "-6"], "first=-6: expected"),
        (["--frames", "0"], "frames=0: expected"),
        (["--out", "film.webp"], r"film.webp: expected a .gif"),
        (["--out", ""], "--out is empty"),
    ],
)
def test_a_film_that_cannot_be_made_is_refused_before_the_episode(
    options, message, quick_run, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("stad_lab.viz.video.record_trajectory", None)  # no episode begins
    out = [] if "--out" in options else ["--out", "film.gif"]
    assert re.search(message, the_error(capsys, "film", "--agent", quick_run, *out, *options))
    assert not any(tmp_path.iterdir())


# Wrong usage


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (["--variant", "both"], ["--variant", "'both'", *VARIANTS]),
        (["--until", "end"], ["--until", "'end'", *STAGES]),
        (["--vae.strid", "2"], ["--vae.strid", "--vae.stride"]),
        (["--vae.stride"], ["--vae.stride", "Expected 1"]),
        (["--vae.stride", "x"], ["--vae.stride", "'x'"]),
        (["--vae.stride", "2.7"], ["--vae.stride", "'2.7'"]),
        (["--vae.stride", "0"], ["vae.stride=0", "expected 1 to"]),
        (["--vae.kl-weight", "1e999"], ["vae.kl_weight=inf", "expected 0 to"]),
        (["--evolution.sigma", "NaN"], ["evolution.sigma=nan", "expected 1e-12 to"]),
        (["--evolution.features", "x"], ["--evolution.features", "'x'"]),
        (["--data.crop-bar", "maybe"], ["maybe"]),
        (["--earlier", "first"], ["data.agent_episodes=0", "a second iteration needs both"]),
    ],
)
def test_a_wrong_name_or_value_ends_in_one_clear_line(options, parts, tmp_path, capsys):
    error = the_error(capsys, *train_quickly(tmp_path / "run", "--until", "dataset", *options))
    assert [part for part in parts if part not in error] == []
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("train fats --out run", "unknown preset 'fats': choose one of quick, fast, laptop, paper"),
        ("compet --help", "unknown command 'compet': choose one of train, fine-tune"),
        ("train quick", "--out"),
        ("", "Missing subcommand"),
        ("evaluate --agent", "error: Missing value for argument '--agent'"),
        ("driving", "driving"),
        ("evaluate --agent nowhere", "no trained agent named 'nowhere': expected "),
        ("verify --run nowhere", "nowhere"),
    ],
)
def test_wrong_usage_ends_in_one_clear_line(command, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert message in the_error(capsys, *command.split())
    assert not any(tmp_path.iterdir())


def test_an_error_of_a_user_has_no_traceback(tmp_path, command_line):
    process = command_line("train", "quick", "--out", tmp_path / "run", "--variant", "both")
    assert process.returncode == 2
    (error,) = (line for line in process.stderr.splitlines() if "XDG_RUNTIME_DIR" not in line)
    assert error.startswith("error: ") and "'both'" in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "command",
    ["train quick", "fine-tune --run frame"],
)
@pytest.mark.parametrize("out", ["", " "])
def test_an_empty_out_is_refused_and_never_means_this_folder(
    command, out, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    error = the_error(capsys, *command.split(), "--out", out)
    assert "--out is empty: give the name of a folder or file" in error
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--episodes", "0"], "episodes=0"),
        (["--first-track", "-5"], "first_track=-5"),
        (["--processes", "0"], "processes=0"),
    ],
)
def test_a_wrong_number_ends_in_one_clear_line(options, message, run, capsys):
    assert message in the_error(capsys, *evaluate_quickly(run), *options)
    assert not list(run.glob("evaluation*"))


# Damaged and foreign files


def test_damaged_weights_end_in_one_clear_line(run, capsys):
    file = run / "mdn_rnn.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    error = the_error(capsys, *evaluate_quickly(run))
    assert f"{file} is damaged" in error
    assert "delete it and train it: python -m stad_lab train --help" in error
    assert not list(run.glob("evaluation*"))


@pytest.mark.parametrize(
    ("option", "value", "was"),
    [("--vae.stride", 2, "vae.stride=4"), ("--variant", "frame", "variant='input_output'")],
)
def test_a_run_of_another_configuration_ends_in_one_clear_line(option, value, was, run, capsys):
    before = states(run)
    error = the_error(capsys, *train_quickly(run, option, value))
    parts = str(run), was, str(value), "choose another folder, or the same settings"
    assert [part for part in parts if part not in error] == []
    assert states(run) == before


def test_a_preset_may_stand_anywhere_and_a_wrong_one_in_the_environment_breaks_train_alone(
    monkeypatch,
):
    orders = ("quick --out run", "--out run quick", "--out quick quick", "--out=run quick")
    flags = ("--tensorboard", "--no-tensorboard", "--data.no-crop-bar", "--data.no_crop_bar")
    for command in (*orders, *(f"--out run {flag} quick" for flag in flags)):
        arguments = parse(["train", *command.split()]).keywords
        asked = QUICK.replace(data={"crop_bar": "crop" not in command})
        assert arguments["config"] == asked and arguments["out"] in ("run", "quick")
    monkeypatch.setenv("STAD_LAB_PRESET", "bogus")
    assert parse(["evaluate", "--agent", "frame"]).keywords["agent"] == "frame"
    with pytest.raises(ValueError, match="unknown preset 'bogus'"):
        parse(["train", "--out", "run"])


@pytest.mark.parametrize(
    "message",
    ["could not create a primitive", "[enforce fail] DefaultCPUAllocator: can't allocate memory"],
)
def test_memory_that_is_too_short_is_named_as_such(message):
    for error in (RuntimeError(message), TaskError(f"drive_group failed in a worker: {message}")):
        assert command_line.explain(error) == f"too large for this machine: {error}"


@pytest.mark.parametrize("made", [True, False])
def test_a_missing_or_empty_run_folder_ends_in_one_clear_line(made, tmp_path, capsys):
    folder = tmp_path / "run"
    if made:
        folder.mkdir()
    error = the_error(capsys, *evaluate_quickly(folder))
    assert f"no trained agent named '{folder}'" in error
    assert "the folder of a finished run of `python -m stad_lab train`" in error


def test_an_out_that_is_a_file_ends_in_one_clear_line(tmp_path, capsys):
    (tmp_path / "file").touch()
    error = the_error(capsys, *train_quickly(tmp_path / "file", "--until", "dataset"))
    assert str(tmp_path / "file") in error


def test_v_of_another_training_or_size_ends_in_one_clear_line(run, capsys):
    for variant, size in (("frame", 32), ("input_output", 16)):
        config = QUICK.replace(vae={"latent_size": size})
        save_vae(run / "vae.safetensors", VAE(variant, size, 8), config)
        error = the_error(capsys, *evaluate_quickly(run))
        assert "controller.safetensors" in error or "mdn_rnn.safetensors was made with" in error


def test_c_of_another_size_ends_in_one_clear_line(run, capsys):
    named = load_world_model(run).checksums
    save_controller(run / "controller.safetensors", np.zeros(867), variant="frame", **named)
    error = the_error(capsys, *evaluate_quickly(run))
    assert "(867,), expected (171,)" in error
    assert "belongs to a V or M of another size" in error


@pytest.mark.parametrize("part", ["vae", "mdn_rnn"])
def test_training_on_top_of_weights_of_another_size_ends_in_one_clear_line(part, run, capsys):
    for name in ("controller.safetensors", "evolution.json"):
        (run / name).unlink()
    if part == "vae":
        other = QUICK.replace(vae={"latent_size": 16})
        save_vae(run / "vae.safetensors", VAE("input_output", 16, 8), other)
        (run / "mdn_rnn.safetensors").unlink()
    else:
        checksum = load_vae(run / "vae.safetensors")[1]["weights"]
        other = QUICK.replace(mdn_rnn={"hidden_size": 16})
        save_mdn_rnn(run / "mdn_rnn.safetensors", MDNRNN(32, 16, 5), other, [], checksum)
    error = the_error(capsys, *train_quickly(run))
    assert f"{part}.safetensors was made with {part}." in error
    assert "_size=16" in error


def test_weights_of_an_impossible_architecture_end_in_one_clear_line(run, capsys):
    tensors, metadata = load_tensors(run / "vae.safetensors")
    metadata["vae"]["width"] = "wide"
    save_tensors(run / "vae.safetensors", tensors, **metadata)
    error = the_error(capsys, *evaluate_quickly(run))
    assert "vae.safetensors is not a file of this kind: vae.width='wide' is a str" in error


def test_weights_that_do_not_fit_their_own_metadata_end_in_one_clear_line(run, capsys):
    save_vae(run / "vae.safetensors", VAE("input_output", 32, 8), QUICK.replace(vae={"width": 16}))
    error = the_error(capsys, *evaluate_quickly(run))
    assert str(run / "vae.safetensors") in error
    assert "belong to another variant or size" in error


def test_a_dataset_file_cut_short_ends_in_one_clear_line(run, capsys):
    file = run / "dataset" / "00003.frames.npy"
    file.write_bytes(file.read_bytes()[:2000])
    for name in ("vae.safetensors", "mdn_rnn.safetensors", "evolution.json"):
        (run / name).unlink()
    error = the_error(capsys, *train_quickly(run))
    assert f"{file} is damaged, its checksum is not the manifest's: delete" in error
    assert "collect again" in error


# The machine


@pytest.mark.parametrize("error", [None, torch.OutOfMemoryError("CUDA out of memory")])
def test_a_lack_of_memory_that_pytorch_finds_ends_in_one_line(error, tmp_path, monkeypatch, capsys):
    def train(*_):
        if error:
            raise error
        torch.empty(2**50)

    monkeypatch.setattr("stad_lab.training.pipeline.train", train)
    assert "too large for this machine" in the_error(capsys, *train_quickly(tmp_path / "run"))


def test_a_fault_of_ours_is_not_taken_for_a_lack_of_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "stad_lab.training.pipeline.train", lambda *_: torch.ones(2) @ torch.ones(3)
    )
    with pytest.raises(RuntimeError, match="inconsistent tensor size"):
        call(*train_quickly(tmp_path / "run"))


def test_an_interrupt_says_that_the_same_command_continues(tmp_path, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("stad_lab.training.pipeline.train", interrupt)
    assert call(*train_quickly(tmp_path / "run")) == 130
    assert capsys.readouterr().err == "\nstopped; the same command continues from there\n"


def test_a_folder_whose_letters_the_console_lacks_is_no_error(quick_run, tmp_path, monkeypatch):
    run = shutil.copytree(quick_run, tmp_path / "\u0141\u00f3d\u017a")
    console = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", console)
    assert call(*train_quickly(run)) == 0
    console.flush()
    printed = console.buffer.getvalue()
    assert b"nothing to do" in printed and b"\\u0141" in printed


@pytest.mark.parametrize("option", ["--dataset", "--earlier", "--out"])
def test_an_empty_folder_is_not_the_present_one(option, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    error = the_error(capsys, *train_quickly(tmp_path / "run", option, ""))
    assert f"{option} is empty" in error and not list(tmp_path.glob("*.npy"))


@pytest.mark.parametrize("command", ["report --run", "verify --run", "train quick --out"])
def test_a_file_in_the_place_of_a_run_is_named(command, tmp_path, capsys):
    (tmp_path / "notes.md").write_text("mine")
    error = the_error(capsys, *command.split(), str(tmp_path / "notes.md"))
    assert "notes.md is a file: give the folder of a run" in error
    assert (tmp_path / "notes.md").read_text() == "mine"


def test_parsing_a_command_does_not_run_it(monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "verify", lambda: pytest.fail("it ran"))
    assert callable(parse(["verify"]))
