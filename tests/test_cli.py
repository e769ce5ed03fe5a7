"""The command line: two runs of one command, help that helps, and one clear line for every mistake."""

import dataclasses
import importlib.metadata
import io
import json
import os
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

from stad_lab.__main__ import build_parser, main, read_changes
from stad_lab.agent import save_controller
from stad_lab.config import PRESETS, Settings
from stad_lab.io.files import load_json, save_json
from stad_lab.models.mdn_rnn import MDNRNN, save_mdn_rnn
from stad_lab.models.vae import VARIANTS, AutoEncoder, save_autoencoder
from stad_lab.training.pipeline import command_of
from stad_lab.viz.video import film_agent

ROOT = Path(__file__).parent.parent


@pytest.fixture
def run(quick_run, tmp_path):
    """A copy of the quick run that a test may damage."""
    return shutil.copytree(quick_run, tmp_path / "run")


def states(folder):
    """Bytes and time of the last change of every file under a folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {
        path.relative_to(folder).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in files
    }


def evaluate_quickly(folder, variant="input_output"):
    """The arguments of a short evaluation."""
    return ["evaluate", "--variant", variant, "--path", folder, "--fast", "--episodes", "1"]


def train_quickly(folder, *changes, variant="input_output"):
    """The arguments of the quick run's command."""
    return ["train", "--variant", variant, "--settings", "quick", "--out", folder, *changes]


def the_error(capsys, arguments):
    """The one line that a command prints before it ends with status 2."""
    assert main([str(argument) for argument in arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


def test_the_quick_run_takes_less_than_a_minute(quick_training):
    assert quick_training[2] < 60


def test_a_run_leaves_weights_log_and_record(quick_training):
    folder, process, _ = quick_training
    for stage in ("rollouts", "autoencoder", "mdn_rnn", "controller"):
        assert f"{stage}: done" in process.stdout
    names = ["autoencoder", "controller", "mdn_rnn"]
    assert sorted(file.stem for file in folder.glob("*.safetensors")) == names
    record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
    assert record["variant"] == "input_output"
    assert Settings.from_dict(record["settings"]) == PRESETS["quick"]
    assert record["seconds"].keys() == {"rollouts", "autoencoder", "mdn_rnn", "controller"}
    assert record["peak_memory"].keys() == record["seconds"].keys()
    if sys.platform != "win32":
        assert all(
            50 < peak < 3000
            for (stage,) in record["peak_memory"].values()
            for peak in stage.values()
        )
    assert record["made_with"]["torch"] == importlib.metadata.version("torch")
    assert record["budget"]["random"] == {"episodes": 8, "frames": 8 * 60}
    assert record["budget"]["agents"] == record["budget"]["evolution"]["episodes"] == 4 * 4
    assert record["budget"]["validation"]["episodes"] == 2 * 2


def test_the_second_run_of_a_command_does_nothing_and_says_so(run, capsys):
    before = states(run)
    assert main([str(argument) for argument in train_quickly(run)]) == 0
    told = capsys.readouterr().out
    assert f"everything up to controller is there in {run}: nothing to do" in told
    assert told.count("already there, nothing to do") == 4
    after = states(run)
    assert after.keys() == before.keys()
    assert [name for name in after if after[name][0] != before[name][0]] == []
    assert [name for name in after if after[name][1] != before[name][1]] == []


def test_a_budget_that_a_kill_left_behind_is_counted_again_and_a_later_start_by_other_means_is_told(
    run, capsys
):
    whole = load_json(run / "record.json")
    old = whole["made_with"] | {"commit": "an earlier one"}
    save_json(
        run / "record.json",
        whole | {"budget": {"random": whole["budget"]["random"]}, "made_with": old},
    )
    for _ in range(2):
        assert main([str(argument) for argument in train_quickly(run)]) == 0
        record = load_json(run / "record.json")
        assert record["budget"] == whole["budget"] and record["seconds"] == whole["seconds"]
        assert record["made_with"] == old and record["continued_with"] == [whole["made_with"]]


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (
            "train",
            [
                "--variant",
                "--settings",
                "--out",
                "--rollouts",
                "--until",
                "--set",
                *VARIANTS,
                *PRESETS,
                "mdn_rnn",
            ],
        ),
        (
            "evaluate",
            [
                "--variant",
                "--path",
                "--episodes",
                "--first-track",
                "--fast",
                "--processes",
                "--json",
            ],
        ),
        ("benchmark", ["--part", "--rounds", "--json", "parity", "renderer", "loop", "training"]),
        ("ship", ["--variant", "--path"]),
        ("table", ["--records", "--picture"]),
        ("film", ["--variant", "--path", "--out", "--track", "--first", "--frames", "--viewer"]),
        ("probe", ["--variant", "--path", "--drives", "--processes", "--json"]),
        (
            "study",
            ["--settings", "--out", "--rollouts", "--part", "probe", "autoencoder", "mdn_rnn"],
        ),
    ],
)
def test_help_names_every_option(command, options, capsys):
    with pytest.raises(SystemExit) as exit:
        main([command, "--help"])
    assert exit.value.code == 0
    text = capsys.readouterr().out
    assert [
        one for one in options if not re.search(rf"(?<![\w-]){re.escape(one)}(?![\w-])", text)
    ] == []


COMMANDS = [
    "check",
    "train",
    "finish",
    "evaluate",
    "verify",
    "replicate",
    "table",
    "probe",
    "study",
    "benchmark",
    "ship",
    "film",
]


def test_help_names_every_setting(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert ", ".join(field.name for field in dataclasses.fields(Settings)) in text


def test_the_first_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as exit:
        main(["--help"])
    assert exit.value.code == 0
    text = capsys.readouterr().out
    assert [command for command in COMMANDS if command not in text] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_has_a_sentence_in_the_help(command):
    (choices,) = (action for action in build_parser()._actions if action.dest == "command")
    parser = choices.choices[command]
    for action in parser._actions:
        assert action.help, action.dest
        assert all(option in parser.format_help() for option in action.option_strings)


def test_until_stops_after_a_stage_and_set_changes_a_setting(tmp_path, capsys):
    arguments = [
        *train_quickly(tmp_path, variant="frame"),
        "--until",
        "rollouts",
        "--set",
        "stride=2",
    ]
    arguments += ["--set", "episodes=2", "--set", "crop_bar=false", "--set", "kl_weight=0.5"]
    assert main([str(argument) for argument in arguments]) == 0
    assert "rollouts: done" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", "record.json", "rollouts"]
    settings = json.loads((tmp_path / "record.json").read_text(encoding="utf-8"))["settings"]
    changes = {"stride": 2, "episodes": 2, "crop_bar": False, "kl_weight": 0.5}
    assert Settings.from_dict(settings) == Settings.preset("quick", **changes)


def test_the_command_in_a_record_asks_for_the_settings_of_that_record():
    settings = Settings.preset("laptop", crop_bar=False, stride=2, sigma_decay=0.0, features="z")
    said = shlex.split(command_of("input", settings))
    changes = [said[place + 1] for place, word in enumerate(said) if word == "--set"]
    assert len(changes) == 4
    assert Settings.preset(said[said.index("--settings") + 1], **read_changes(changes)) == settings


@pytest.mark.parametrize(("name", "options"), [("drive.gif", []), ("drive.webp", ["--viewer"])])
def test_a_film_is_a_moving_picture(name, options, quick_run, tmp_path, capsys):
    file = tmp_path / name
    arguments = [
        "film",
        "--variant",
        "input_output",
        "--path",
        quick_run,
        "--out",
        file,
        "--first",
        20,
        "--frames",
        12,
    ]
    assert main([str(argument) for argument in (*arguments, *options)]) == 0
    assert f"filmed to {file}" in capsys.readouterr().out
    with Image.open(file) as film:
        assert film.format.lower() == file.suffix[1:]
        pictures = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    assert len(pictures) == 4  # every third frame
    assert not np.array_equal(pictures[0], pictures[-1])


def test_a_number_too_large_for_any_machine_ends_in_one_line(quick_run, tmp_path, capsys):
    file = tmp_path / "evaluation.json"
    command = [
        "evaluate",
        "--variant",
        "input_output",
        "--path",
        quick_run,
        "--json",
        file,
        "--processes",
        2**31,
    ]
    assert main([str(argument) for argument in command]) == 2
    assert "error: too large for this machine: " in capsys.readouterr().err and not file.exists()


@pytest.mark.parametrize("error", [None, torch.OutOfMemoryError("CUDA out of memory")])
def test_a_lack_of_memory_that_pytorch_finds_ends_in_one_line(error, tmp_path, monkeypatch, capsys):
    def train(*_, **__):
        if error:
            raise error
        torch.empty(2**50)

    monkeypatch.setattr("stad_lab.__main__.train", train)
    assert "too large for this machine" in the_error(capsys, train_quickly(tmp_path / "run"))


def test_an_error_of_ours_is_not_taken_for_a_lack_of_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("stad_lab.__main__.train", lambda *_, **__: torch.ones(2) @ torch.ones(3))
    with pytest.raises(RuntimeError, match="inconsistent tensor size"):
        main(train_quickly(str(tmp_path / "run")))


def test_a_number_may_be_written_as_people_write_it():
    assert read_changes(["sigma=.5", "kl_weight=2"]) == {"sigma": 0.5, "kl_weight": 2.0}


def test_every_command_line_of_the_pages_is_one():
    pages = [
        page.read_text(encoding="utf-8")
        for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
    ]
    blocks = [
        block for page in pages for block in re.findall(r"^```sh\n(.*?)^```", page, re.M | re.S)
    ]
    lines = [
        line
        for block in blocks
        for line in re.findall(r"^\S*python -m stad_lab (.*)$", block, re.M)
    ]
    for line in lines:
        build_parser().parse_args(shlex.split(line, comments=True))
    assert len(lines) > 15


def test_the_script_of_the_readme_runs():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```", readme, re.M | re.S)
    whole = '"CarRacing-v3")'
    assert block.count(whole) == 1
    exec(block.replace(whole, '"CarRacing-v3", max_episode_steps=4)'), names := {})
    assert names["ended"] and names["truncated"]


def test_a_film_of_no_frame_is_refused_before_the_drive(agent):
    with pytest.raises(ValueError, match="frames=0: expected at least 1"):
        film_agent(agent, track=0, first=0, frames=0)


@pytest.mark.parametrize(
    ("does", "arguments", "given"),
    [
        (
            "train",
            "--variant input --settings quick --out run --rollouts shared --earlier first --until mdn_rnn",
            (
                "input",
                Settings.preset("quick"),
                Path("run"),
                Path("shared"),
                "mdn_rnn",
                None,
                Path("first"),
            ),
        ),
        ("ship", "--variant frame --path run", ("frame", Path("run"))),
        ("keep", "--row one_round --out table --seeds 1 2 --keep", ("one_round", Path("table"))),
    ],
)
def test_every_option_of_a_command_reaches_what_it_is_for(
    does, arguments, given, monkeypatch, capsys
):
    told = []
    monkeypatch.setattr(
        f"stad_lab.__main__.{does}", lambda *all, **named: told.append((all, named)) or ["here"]
    )
    command = "replicate" if does == "keep" else does
    assert main([command, *arguments.split()]) == 0
    assert told == [(given, {"seeds": [1, 2]} if does == "keep" else {})]


@pytest.mark.parametrize(
    "command",
    [
        "train --variant input --settings quick --out run --set name=laptop",
        "finish --variant input --out run --set earlier=x",
    ],
)
def test_a_setting_that_is_none_to_change_ends_in_one_clear_line(
    command, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert re.search(
        "the name cannot be set; choose a preset|unknown setting 'earlier'",
        the_error(capsys, command.split()),
    )
    assert not any(tmp_path.iterdir())


def test_a_result_is_written_where_it_is_wanted_and_not_over_a_folder(run, tmp_path, capsys):
    wanted = tmp_path / "made" / "result.json"
    assert main([str(argument) for argument in [*evaluate_quickly(run), "--json", wanted]]) == 0
    assert len(load_json(wanted)["episodes"]) == 1
    capsys.readouterr()
    error = the_error(capsys, [*evaluate_quickly(run), "--json", wanted.parent])
    assert "is a folder: give the name of a file" in error
    if hasattr(
        os, "mkfifo"
    ):  # a device would be replaced by a file, for every program on the machine
        os.mkfifo(tmp_path / "device")
        error = the_error(capsys, [*evaluate_quickly(run), "--json", tmp_path / "device"])
        assert (
            "is no ordinary file: give the name of a file" in error
            and (tmp_path / "device").is_fifo()
        )


def test_a_start_that_was_refused_may_be_made_again_with_other_settings(
    tmp_path, monkeypatch, capsys
):
    command = [
        "train",
        "--variant",
        "frame",
        "--settings",
        "quick",
        "--until",
        "rollouts",
        "--out",
        str(tmp_path),
    ]
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=1000))
    assert "collect fewer or shorter episodes" in the_error(capsys, command)
    monkeypatch.undo()
    fewer = [*command, "--set", "episodes=2"]
    assert main(fewer) == 0
    assert load_json(tmp_path / "record.json")["settings"]["episodes"] == 2
    capsys.readouterr()
    assert "choose another folder" in the_error(capsys, command)  # now there is something to lose


def test_a_folder_whose_letters_the_console_lacks_is_no_error(quick_run, tmp_path, monkeypatch):
    run = shutil.copytree(quick_run, tmp_path / "\u0141\u00f3d\u017a")
    console = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", console)
    assert (
        main(["train", "--variant", "input_output", "--settings", "quick", "--out", str(run)]) == 0
    )
    console.flush()
    assert b"nothing to do" in console.buffer.getvalue() and b"\\u0141" in console.buffer.getvalue()


def test_an_unknown_variant_ends_in_one_clear_line(tmp_path, command_line):
    process = command_line(*train_quickly(tmp_path / "run", variant="both"))  # as a user starts it
    assert process.returncode == 2
    (error,) = (line for line in process.stderr.splitlines() if "XDG_RUNTIME_DIR" not in line)
    assert error.startswith("error: unknown variant 'both': choose one of " + ", ".join(VARIANTS))
    assert not (tmp_path / "run").exists()


def test_damaged_weights_end_in_one_clear_line(run, capsys):
    file = run / "mdn_rnn.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    error = the_error(capsys, evaluate_quickly(run))
    assert (
        f"{file} is damaged" in error
        and "delete it and train it: python -m stad_lab train --help" in error
    )
    assert not (run / "evaluation.json").exists()


def test_a_run_folder_of_other_settings_ends_in_one_clear_line(run, capsys):
    before = states(run)
    error = the_error(capsys, train_quickly(run, "--set", "stride=2"))
    parts = str(run), "stride=4", "stride=2", "choose another folder, or the same"
    assert [part for part in parts if part not in error] == []
    assert states(run) == before


def test_an_unknown_preset_ends_in_one_clear_line(tmp_path, capsys):
    error = the_error(
        capsys, ["train", "--variant", "input", "--settings", "fast", "--out", tmp_path / "run"]
    )
    assert "unknown settings 'fast': choose one of quick, laptop, paper" in error


@pytest.mark.parametrize("options", [["--until", "end"], ["--set", "strid=2"], ["--set", "stride"]])
def test_an_unknown_stage_or_setting_ends_in_one_clear_line(options, tmp_path, capsys):
    error = the_error(capsys, train_quickly(tmp_path / "run", *options))
    assert repr(options[1].split("=")[0]) in error
    assert any(
        remedy in error
        for remedy in ("choose one of rollouts", "the settings are name,", "expected NAME=VALUE")
    )


@pytest.mark.parametrize(
    ("change", "shown"),
    [
        ("stride=x", "x"),
        ("stride=2.7", "2.7"),
        ("stride=1e999", "inf"),
        ("stride=0", "0"),
        ("crop_bar=maybe", "maybe"),
        ("sigma=NaN", "nan"),
    ],
)
def test_a_wrong_value_of_a_setting_ends_in_one_clear_line(change, shown, tmp_path, capsys):
    error = the_error(
        capsys, train_quickly(tmp_path / "run", "--until", "rollouts", "--set", change)
    )
    assert change.split("=")[0] in error
    assert shown in error
    assert "expected" in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("made", [True, False])
def test_a_missing_or_empty_run_folder_ends_in_one_clear_line(made, tmp_path, capsys):
    folder = tmp_path / "run"
    if made:
        folder.mkdir()
    error = the_error(capsys, evaluate_quickly(folder, "input"))
    assert f"{folder} is {'empty' if made else 'not a folder'}" in error
    assert (
        f"expected a run made by `python -m stad_lab train --variant input --out {folder}`" in error
    )


def test_an_unfinished_run_ends_in_one_clear_line(run, capsys):
    (run / "controller.safetensors").unlink()
    error = the_error(capsys, evaluate_quickly(run))
    assert (
        f"{run / 'controller.safetensors'} does not exist: train it: python -m stad_lab train --help"
        in error
    )


def test_an_out_that_is_a_file_ends_in_one_clear_line(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert str(tmp_path / "file") in the_error(
        capsys, train_quickly(tmp_path / "file", "--until", "rollouts")
    )


@pytest.mark.parametrize("command", [evaluate_quickly, train_quickly])
def test_a_run_of_another_variant_ends_in_one_clear_line(command, run, capsys):
    error = the_error(capsys, command(run, variant="frame"))
    assert str(run) in error
    assert "'input_output'" in error
    assert "'frame'" in error
    assert "give its own run" in error or "choose another folder" in error


def test_weights_of_another_variant_end_in_one_clear_line(run, capsys):
    save_autoencoder(
        run / "autoencoder.safetensors", AutoEncoder("frame", 32, 8), PRESETS["quick"], []
    )
    for arguments in (evaluate_quickly(run), train_quickly(run)):
        error = the_error(capsys, arguments)
        assert (
            f"{run / 'autoencoder.safetensors'} holds variant 'frame', and 'input_output' was asked for"
            in error
        )
        assert "give its own run" in error


def test_v_of_another_size_ends_in_one_clear_line(run, capsys):
    save_autoencoder(
        run / "autoencoder.safetensors", AutoEncoder("input_output", 16, 8), PRESETS["quick"], []
    )
    error = the_error(capsys, evaluate_quickly(run))
    assert (
        "mdn_rnn.safetensors was made with another autoencoder than the one beside it: give V, M and C"
        in error
    )


def test_c_of_another_size_ends_in_one_clear_line(run, capsys):
    save_controller(run / "controller.safetensors", np.zeros(867), variant="input_output")
    error = the_error(capsys, evaluate_quickly(run))
    assert "(867,), expected (171,)" in error
    assert "belongs to a V or M of another size" in error


@pytest.mark.parametrize("part", ["autoencoder", "mdn_rnn"])
def test_training_on_top_of_weights_of_another_size_ends_in_one_clear_line(part, run, capsys):
    if part == "autoencoder":
        save_autoencoder(
            run / f"{part}.safetensors", AutoEncoder("input_output", 16, 8), PRESETS["quick"], []
        )
        (run / "mdn_rnn.safetensors").unlink()
    else:
        save_mdn_rnn(
            run / f"{part}.safetensors", MDNRNN(16, 24, 5), "input_output", PRESETS["quick"], []
        )
    (run / "controller.safetensors").unlink()
    (run / "evolution.json").unlink()
    error = the_error(capsys, train_quickly(run))
    assert f"{part}.safetensors" in error
    assert "16" in error
    assert "32" in error


def test_weights_that_do_not_fit_their_own_header_end_in_one_clear_line(run, capsys):
    autoencoder = AutoEncoder("input_output", 32, 8)
    autoencoder.width = 16
    save_autoencoder(run / "autoencoder.safetensors", autoencoder, PRESETS["quick"], [])
    error = the_error(capsys, evaluate_quickly(run))
    assert str(run / "autoencoder.safetensors") in error
    assert "belong to another variant or size" in error


def test_a_rollout_file_cut_short_ends_in_one_clear_line(run, capsys):
    block = run / "rollouts" / "00003.frames.npy"
    block.write_bytes(block.read_bytes()[:2000])
    (run / "autoencoder.safetensors").unlink()
    error = the_error(capsys, train_quickly(run))
    assert f"{block} is damaged (2000 bytes, not the checksum in the manifest): delete" in error
    assert "collect again" in error


@pytest.mark.parametrize(
    "options", [["--episodes", "0"], ["--first-track", "-5"], ["--processes", "0"]]
)
def test_a_wrong_number_ends_in_one_clear_line(options, run, capsys):
    error = the_error(capsys, [*evaluate_quickly(run), *options])
    assert f"{options[0].strip('-').replace('-', '_')}={options[1]}" in error
    assert "expected" in error


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--track", "-1"], "track=-1: expected at least 0"),
        (["--first", "-6"], "first=-6: expected at least 0"),
        (["--frames", "0"], "frames=0: expected at least 1"),
        (["--out", "drive.webp"], "drive.webp: expected a file that ends in .gif"),
    ],
)
def test_a_film_that_cannot_be_made_is_refused_before_the_drive(
    options, message, quick_run, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    arguments = [
        "film",
        "--variant",
        "input_output",
        "--path",
        quick_run,
        "--out",
        "drive.gif",
        *options,
    ]
    assert main([str(argument) for argument in arguments]) == 2
    assert message in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_a_film_of_another_kind_is_refused_before_the_drive(quick_run, tmp_path, capsys):
    arguments = [
        "film",
        "--variant",
        "input_output",
        "--path",
        quick_run,
        "--out",
        tmp_path / "drive.mp4",
        "--viewer",
    ]
    assert main([str(argument) for argument in arguments]) == 2
    assert "error: kind='mp4': expected 'gif' or 'webp'" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
