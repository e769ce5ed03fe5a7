"""The competition: a submission costs itself alone, and a ranking can be continued and checked."""

import contextlib
import functools
import json
import os
import shutil
import sys
import time
import zlib

import numpy as np
import pytest
from course.submissions import CHEATS, MISBEHAVE, source, write_class

import stad_lab
from stad_course.cli import main
from stad_course.compete.drive import (
    LOST,
    MOST_FAILURES,
    STARTER,
    check_submission,
    drive_batch,
    find_submissions,
    fingerprint,
)
from stad_course.compete.limits import Limits
from stad_course.compete.process import LARGEST_SUBMISSION, Failure, Submission, can_isolate, copied
from stad_course.compete.ranking import rank
from stad_course.compete.tracks import hide_tracks
from stad_lab.agent import PRETRAINED, rollout
from stad_lab.envs.cars import Cars
from stad_lab.io.files import load_json, save_json

SHORT = ("--limits.start", "20", "--limits.step", "10")  # a busy machine is no fault
HARMLESS = {"kills_itself"} if can_isolate() else set()  # the first process of a namespace cannot


def hold(folder, good, misbehaving, tracks, *options):
    """Run a competition by its command, and return the results by name."""
    write_class(folder / "class", good, misbehaving)
    secret, out = str(folder / "tracks.json"), str(folder / "out")
    assert main(["commit", secret, "--tracks", str(tracks)]) == 0
    submissions = str(folder / "class")
    assert main(["compete", submissions, "--out", out, "--secret", secret, *options]) == 0
    return {file.stem: load_json(file) for file in (folder / "out" / "results").iterdir()}


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """A small competition: its folder, and its results."""
    folder = tmp_path_factory.mktemp("competition")
    return folder, hold(folder, 1, ("crash", "nan"), 2, *SHORT, "--no-baselines")


def test_a_submission_that_breaks_down_costs_itself_alone_and_its_author_reads_why(held):
    _, results = held
    for name in ("crash", "nan"):
        assert results[name]["returns"] == [-100, -100]
        assert MISBEHAVE[name][2] in results[name]["failures"][0]
    assert results["student00"]["failures"] == [] and min(results["student00"]["returns"]) > 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows lets not every user make links")
def test_a_link_in_a_submission_is_not_followed(tmp_path):
    (folder := tmp_path / "one").mkdir()
    (folder / "agent.py").write_text("")
    (secret := tmp_path / "secret.json").write_text("1")
    (folder / "link").symlink_to(secret)
    before = fingerprint(folder)
    assert (copied(folder, tmp_path / "out") / "link").is_symlink()
    with secret.open("wb") as file:
        file.truncate(LARGEST_SUBMISSION + 1)
    assert fingerprint(folder) == before


def test_a_trained_run_can_be_handed_in_as_it_is_with_its_large_dataset(tmp_path):
    run = tmp_path / "run"
    shutil.copytree(PRETRAINED / "cropped_input", run)
    for place in (run / "dataset", run / "more"):
        place.mkdir()
        with (place / "episodes.bin").open("wb") as file:
            file.truncate(LARGEST_SUBMISSION + 1)  # a hole, which takes no disk
    with pytest.raises(Failure, match="MB, at most 300"):
        copied(run, tmp_path)
    assert fingerprint(run).endswith(" bytes")  # it is not read
    shutil.rmtree(run / "more")
    (out := tmp_path / "out").mkdir()
    before = fingerprint(run)
    names = {file.name for file in copied(run, out).iterdir()}
    assert names == {file.name for file in run.iterdir()} - {"dataset"}
    shutil.rmtree(run / "dataset")
    assert fingerprint(run) == before  # and it is not read


def test_what_a_child_prints_or_patches_changes_no_score(held):
    _, results = held
    for name in CHEATS:
        assert results[name]["failures"] == [] and max(results[name]["returns"]) < 900


def test_a_competition_continues_with_the_same_ranking(held):
    folder, results = held
    kept = folder / "out" / "results"
    (kept / "student00.json").unlink()
    before = {file: file.stat().st_mtime_ns for file in kept.iterdir()}
    again = hold(folder, 1, ("crash", "nan"), 2, *SHORT, "--no-baselines")
    assert {name: one["returns"] for name, one in again.items()} == {
        name: one["returns"] for name, one in results.items()
    }
    assert {file: file.stat().st_mtime_ns for file in before} == before  # not driven again


def test_the_hash_is_known_before_the_seeds_and_the_page_holds_both_only_afterwards(held, capsys):
    folder, _ = held
    page, secret = folder / "out" / "leaderboard.html", folder / "tracks.json"
    told = json.loads(secret.read_text(encoding="utf-8"))
    assert hide_tracks(secret, 2) in page.read_text(encoding="utf-8")
    assert str(told["tracks"][0]) not in page.read_text(encoding="utf-8")
    hold(folder, 1, ("crash", "nan"), 2, *SHORT, "--no-baselines", "--reveal")
    assert str(told["tracks"][0]) in page.read_text(encoding="utf-8")
    assert ("had no network" in page.read_text(encoding="utf-8")) == can_isolate()
    result = folder / "out" / "results" / "student00.json"  # as driven where nothing is isolated
    save_json(result, load_json(result) | {"isolated": False})
    hold(folder, 1, ("crash", "nan"), 2, *SHORT, "--no-baselines")
    assert "had no network" not in page.read_text(encoding="utf-8")


@pytest.mark.skipif(not can_isolate(), reason="this system starts no process in namespaces")
def test_a_submission_sees_neither_hidden_tracks_nor_other_processes_and_writes_nowhere(tmp_path):
    secret, file = tmp_path / "tracks.json", tmp_path / "spy.py"
    hide_tracks(secret, 2)
    file.write_text(
        "import pathlib\n"
        f"assert not pathlib.Path({str(secret)!r}).read_bytes(), 'saw the tracks'\n"
        "assert len([p for p in pathlib.Path('/proc').iterdir() if p.name.isdigit()]) < 5\n"
        "import os, subprocess\n"
        f"subprocess.run(['umount', {str(secret)!r}], stderr=subprocess.DEVNULL)\n"
        "subprocess.run(['mount', '-o', 'remount,bind,rw', '/'], stderr=subprocess.DEVNULL)\n"
        f"assert not pathlib.Path({str(secret)!r}).read_bytes(), 'uncovered the tracks'\n"
        "assert len(list(pathlib.Path.cwd().parent.iterdir())) == 1, 'saw another submission'\n"
        "package = pathlib.Path(__import__('stad_lab').__path__[0])\n"
        "for place in (pathlib.Path('/etc'), pathlib.Path('/dev/shm'), package):\n"
        "    try:\n        (place / 'spy').touch()\n"
        "    except OSError:\n        continue\n"
        "    raise AssertionError(f'wrote to {place}')\n"
        "class Agent:\n    def act(self, observation): return [0, 0, 0]\n"
        "make_agent = Agent\n"
    )
    other = Submission(STARTER / "my_agent.py", Limits())
    with other, Submission(file, Limits(), hidden=(secret,)) as driver:
        driver.reset()
        assert driver.act_batch(np.zeros((1, 96, 96, 3), np.uint8)).tolist() == [[0, 0, 0]]


def test_a_subclass_of_our_agent_drives_by_its_own_act_on_an_image_that_it_may_change(tmp_path):
    file = tmp_path / "careful.py"
    file.write_text(
        "from stad_lab.agent import Agent, load_agent\n"
        "class Careful(Agent):\n"
        "    def act(self, observation):\n"
        "        observation[84:] = 0\n"
        "        return [0.25, 0.5, 0]\n"
        "def make_agent():\n"
        "    base = load_agent('frame')\n"
        "    return Careful(base.world_model, base.parameters)\n"
    )
    with Submission(file, Limits(step=10.0)) as driver:
        driver.reset()
        assert driver.act_batch(np.zeros((1, 96, 96, 3), np.uint8)).tolist() == [[0.25, 0.5, 0]]


def test_a_submission_may_have_any_name_that_can_be_shown(tmp_path):
    for name in ("_ada.py", "Jürgen S.py", ".hidden.py", "__init__.py"):
        (tmp_path / name).touch()
    assert sorted(find_submissions(tmp_path)) == ["Jürgen S", "_ada"]
    with contextlib.suppress(OSError):  # some systems refuse such a name
        (tmp_path / "J\udcfcrgen.py").touch()
        with pytest.raises(ValueError, match="has a name that cannot be shown: rename it"):
            find_submissions(tmp_path)


def test_the_kit_passes_its_own_check():
    assert check_submission(STARTER / "my_agent.py", Limits(), tracks=(0,)).startswith("ok")


def test_only_those_are_tied_with_the_first_who_are_not_significantly_behind():
    rng = np.random.default_rng(0)
    best = 900 + rng.normal(0, 10, 30)
    others = {"best": best, "near": best - rng.normal(0, 10, 30), "far": best - 100}
    table = rank([{"name": name, "returns": own.tolist()} for name, own in others.items()])
    tied = dict(zip(table["name"], table["tied"], strict=True))
    assert tied["best"] and tied["near"] and not tied["far"]


@pytest.mark.long
def test_sixty_submissions_of_which_seventeen_misbehave_on_fifty_tracks(tmp_path):
    good = 60 - len(MISBEHAVE) - len(CHEATS)
    results = hold(tmp_path, good, tuple(MISBEHAVE), 50)
    assert len(results) == 60 + 6
    for name, (_, _, said) in MISBEHAVE.items():
        if name not in HARMLESS:
            assert said in results[name]["failures"][0], name
            assert len(results[name]["failures"]) <= MOST_FAILURES
    assert all(not one["failures"] for name, one in results.items() if name not in MISBEHAVE)


def test_results_under_other_conditions_are_refused_and_kept(held, capsys):
    folder, _ = held
    compete = ["compete", str(folder / "class"), "--secret", str(folder / "tracks.json")]
    compete += ["--out", str(folder / "out"), "--no-baselines"]
    before = [file.read_bytes() for file in sorted((folder / "out" / "results").iterdir())]
    assert main([*compete, "--limits.start", "20", "--limits.step", "0.4"]) == 2
    assert "was driven with other limits" in capsys.readouterr().err
    other = folder / "other.json"
    assert main(["commit", str(other), "--tracks", "2"]) == 0
    compete[3] = str(other)
    assert main([*compete, *SHORT]) == 2
    assert "was driven with other tracks" in capsys.readouterr().err
    assert [file.read_bytes() for file in sorted((folder / "out" / "results").iterdir())] == before


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("compete CLASS --secret SECRET --limits.total -1", "limits.total=-1: expected more than"),
        ("compete CLASS --secret SECRET --limits.step nan", "limits.step=nan: expected more than"),
        ("compete CLASS --secret SECRET --limits.memory inf", "limits.memory=inf: expected more"),
        ("compete CLASS --secret SECRET --out CLASS/out", "lies in the folder of submissions"),
        ("compete CLASS --secret SECRET --out PACKAGE", "which submissions need, and is hidden"),
        ("compete CLASS --secret AGENT", "is no file of hidden tracks"),
        ("compete OURS --secret SECRET", "names with 'baseline-' are those of our agents"),
        ("commit SECRET --tracks 7", "has 2 tracks, not 7"),
        ("commit AGENT", "ending in .json"),
        ("check nothing.py", "nothing.py does not exist: expected a Python file"),
        ("kit nothing", "expected a name that ends in .py"),
    ],
)
def test_what_would_cost_results_is_refused_in_one_line(arguments, expected, tmp_path, capsys):
    write_class(tmp_path / "class", 1, ())
    (tmp_path / "ours").mkdir()
    agent = tmp_path / "ours" / "baseline-random.py"
    agent.write_bytes((STARTER / "my_agent.py").read_bytes())
    hide_tracks(tmp_path / "tracks.json", 2)
    places = {"CLASS": "class", "SECRET": "tracks.json", "OURS": "ours"}
    places["PACKAGE"] = stad_lab.__path__[0]
    for name, place in places.items():
        arguments = arguments.replace(name, str(tmp_path / place))
    assert main(arguments.replace("AGENT", str(agent)).split()) == 2
    captured = capsys.readouterr()
    assert expected in captured.err and len(captured.err.strip().splitlines()) == 1
    assert agent.read_bytes() == (STARTER / "my_agent.py").read_bytes()


@pytest.fixture
def short_episodes(monkeypatch):
    """Episodes of 30 frames, where a submission breaks down in the first picture."""
    brief = functools.partial(rollout, max_frames=30)
    monkeypatch.setattr("stad_course.compete.drive.rollout", brief)


@pytest.mark.usefixtures("short_episodes")
def test_each_track_on_which_a_submission_breaks_down_costs_that_track_alone(tmp_path):
    cars = Cars(2)
    cars.reset([3, 5])
    bad = [zlib.crc32(picture.tobytes()) for picture in cars.draw()]
    line = f"if zlib.crc32(observation.tobytes()) in {bad}: raise ValueError(self.frame)"
    path = tmp_path / "breaks.py"
    path.write_text("import zlib\n" + source("act", line))
    result = {"returns": [], "failures": [], "seconds": 0.0, "laps": {}}
    for tracks in (range(4), range(4, 8)):
        drive_batch(path, list(tracks), result, Limits(step=10.0), ())
    assert [n for n, own in enumerate(result["returns"]) if own == LOST] == [3, 5]
    assert len(result["failures"]) == 2


TWO = """
made = []
def make_agent():
    made.append(Agent())
    return made[-1]
class Agent:
    def act(self, observation):
        {line}
        return [0, 0, 0]
"""
LIE = """import os, contextlib
        for one in range(3, 9):
            with contextlib.suppress(OSError):
                os.write(one, b'{"kind": "actions", "size": 24}' + bytes([10] + [0] * 24))"""


@pytest.mark.usefixtures("short_episodes")
@pytest.mark.parametrize(
    ("line", "tracks", "lost", "said"),
    [
        ("if len(made) > 1: raise ValueError('two')", [0, 1], 0, "only with 2 cars at once: Val"),
        (LIE, [0], 1, "it wrote into the pipe of its answers"),
    ],
)
def test_a_failure_that_no_track_shows_and_a_forged_answer_count(
    line, tracks, lost, said, tmp_path
):
    path = tmp_path / "agent.py"
    path.write_text(TWO.format(line=line))
    result = {"returns": [], "failures": [], "seconds": 0.0, "laps": {}}
    drive_batch(path, tracks, result, Limits(step=10.0), ())  # a busy machine is no fault
    assert result["returns"].count(LOST) == lost, result["failures"]
    assert len(result["failures"]) == 1 and said in result["failures"][0]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no fork")
@pytest.mark.parametrize(
    ("number", "named"),
    [(9, "SIGKILL"), *[(40, "signal 40")] * (sys.platform == "linux")],  # elsewhere all have names
)
def test_what_a_dead_submission_has_started_is_not_waited_for(number, named, tmp_path, monkeypatch):
    monkeypatch.setattr("stad_course.compete.process.can_isolate", lambda: False)
    die = f"if os.fork(): os.kill(os.getpid(), {number})"
    line = f"import os, time\n        {die}\n        time.sleep(60)"
    path = tmp_path / "agent.py"
    path.write_text(TWO.format(line=line))
    result = {"returns": [], "failures": [], "seconds": 0.0, "laps": {}}
    begin = time.monotonic()
    drive_batch(path, [0], result, Limits(), ())
    assert named in result["failures"][0] and time.monotonic() - begin < 30


def test_who_used_up_the_whole_time_reads_the_limit_of_the_whole(tmp_path):
    path = tmp_path / "slow.py"
    path.write_text(source("act", "time.sleep(0.3 if self.frame > 1 else 0)"))
    result = {"returns": [], "failures": [], "seconds": 0.0, "laps": {}}
    drive_batch(path, [0], result, Limits(step=2.0, total=1.0), ())
    assert "the limit of 1 s in all" in result["failures"][0]


@pytest.mark.parametrize(
    "arguments",
    [
        ("kit", ""),
        ("check", ""),
        ("commit", ""),
        ("compete", "", "--secret", "tracks.json"),
    ],
)
def test_an_empty_name_is_not_the_present_folder(arguments, capsys):
    assert main(list(arguments)) == 2
    assert "is empty" in capsys.readouterr().err


def test_a_folder_without_an_agent_is_told_what_it_lacks(tmp_path):
    (tmp_path / "notes").mkdir()
    said = check_submission(tmp_path / "notes", Limits(), tracks=(0,))
    assert "neither agent.py with make_agent(), nor a run" in said
