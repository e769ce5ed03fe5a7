"""Study 5: C is evolved again in kept worlds, with motion added to what it sees or taken out."""

import dataclasses
import shutil
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.agent import Agent, drive
from stad_lab.config import Config
from stad_lab.envs.cars import Cars
from stad_lab.evaluation import probe_run
from stad_lab.evaluation.trajectories import true_motion
from stad_lab.io.files import copy_file, load_json, load_tensors
from stad_lab.io.weights import MDN_RNN_FILE, VAE_FILE, load_vae, save_mdn_rnn, save_vae
from stad_lab.models.controller import parameter_count
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training.evolution import LOG
from stad_lab.training.trainer import torch_settings
from stad_study import senses, study5, tables, world_facts
from stad_study.cli import main
from stad_study.evolved import add_run, compare_run, find_runs, recorded, run_evolved
from stad_study.networks import WORLD_MODEL_FILE, keep_world_model, load_kept_world_model
from stad_study.senses import (
    COLUMNS,
    erase,
    motion_directions,
    random_directions,
    removed_variance,
    turning,
    whiten,
)
from stad_study.study import STUDIES
from stad_study.study5 import STUDY5
from stad_study.world_facts import WORLD_FILE, load_sense

CONFIG = Config.preset(
    "quick", evolution={"generations": 2, "max_frames": 20, "components": 8, "features": "z"}
)


@pytest.fixture(scope="module", autouse=True)
def networks(tmp_path_factory):
    """A folder of kept worlds of one tiny seed, whose V and M are untrained."""
    folder = tmp_path_factory.mktemp("networks")
    v, m = CONFIG.vae, CONFIG.mdn_rnn
    for variant in world_facts.SENSED_VARIANTS:
        run, config = folder / variant, CONFIG.replace(variant=variant)
        with torch_settings(0, 0):
            save_vae(run / VAE_FILE, VAE(variant, v.latent_size, v.width), config)
            mdn_rnn = MDNRNN(v.latent_size, m.hidden_size, m.mixtures)
        trained = load_vae(run / VAE_FILE)[1]["weights"]
        save_mdn_rnn(run / MDN_RNN_FILE, mdn_rnn, config, vae=trained)
        keep_world_model(config, run, folder / f"study1/seed0/{variant}" / WORLD_MODEL_FILE)
    tiny = {"seeds": (0,), "config": CONFIG, "tracks": range(1000, 1003), "max_frames": 30}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STUDIES, "study1", dataclasses.replace(STUDIES["study1"], **tiny))
        patch.setattr(world_facts, "PROBED", 12)
        patch.setattr(world_facts, "PLACEBO_EPISODES", 2)
        patch.setattr(senses, "DRAWS", 1000)
        patch.setattr(probe_run, "AGENT_FRAMES", 120)
        yield folder


@pytest.fixture(scope="module")
def made(networks, tmp_path_factory):
    """The folder of one run of each arm, with its tables in `data`."""
    folder = tmp_path_factory.mktemp("study5")
    only = [run.name for run in find_runs(STUDY5) if run.repeat == 1]
    run_evolved(STUDY5, folder, only=only, to=folder / "data", networks=networks)
    return folder


def load(networks, folder, variant, sees):
    """What C sees in a world of the tiny seed."""
    model = load_kept_world_model(networks / f"study1/seed0/{variant}" / WORLD_MODEL_FILE)
    return load_sense(folder / f"study5/seed0/{variant}" / WORLD_FILE, model, sees)[0]


def test_every_arm_has_three_runs_a_seed_with_their_own_evolution_seeds():
    runs = find_runs(STUDY5)
    assert len({run.name for run in runs}) == len(runs) == 12 * 3
    assert {run.config.evolution.seed for run in runs} == {101, 102, 103}
    assert [run.sees for run in runs[:6]] == ["z", "z, h"] * 3


def test_a_run_that_came_into_the_tables_meanwhile_is_not_replaced(made):
    before = tables.read("study5_runs", made / "data")
    with pytest.raises(ValueError, match="from another folder: nothing was added"):
        add_run(STUDY5, find_runs(STUDY5)[0], made / "study5", made / "data")
    assert tables.read("study5_runs", made / "data").equals(before)


def test_the_runs_of_a_repeat_drive_the_same_tracks_and_are_in_the_tables(made):
    table = tables.read("study5_runs", made / "data")
    returns = tables.read("study5_returns", made / "data")
    assert len(table) == len(returns) == 12
    assert np.allclose(
        returns[[str(t) for t in range(1000, 1003)]].mean(axis=1), table["mean"], atol=0.01
    )
    logs = [
        load_json(made / "study5" / run.name / LOG) for run in find_runs(STUDY5) if run.repeat == 1
    ]
    assert len({str([entry["tracks"] for entry in log["generations"]]) for log in logs}) == 1
    assert table["controller"].nunique() > 10  # C that see z - motion and z - placebo differ, too
    kept, _ = load_tensors(made / "networks/study5/seed0.safetensors")
    assert len(kept) == 12


def test_a_run_that_ends_is_added_to_the_tables_and_its_score_is_not_told(
    made, networks, tmp_path, capsys
):
    name, to = "seed0/frame/z/1", tmp_path / "data"
    run_evolved(STUDY5, made, only=[name], to=to, networks=networks)
    (mean,), told = tables.read("study5_runs", to)["mean"], capsys.readouterr().out
    assert f"{name}: is finished" in told and f"{mean:.1f}" not in told


def test_a_repeated_run_is_compared_with_the_recorded_one(made, networks, tmp_path, capsys):
    name = "seed0/input_output"
    world = tmp_path / "study5" / name / WORLD_FILE
    world.parent.mkdir(parents=True)
    shutil.copy(made / "study5" / name / WORLD_FILE, world)
    only = [f"{name}/z_-_motion/1"]
    run_evolved(STUDY5, tmp_path, only=only, to=made / "data", networks=networks)
    assert "bit-identical" in capsys.readouterr().out
    with pytest.raises(ValueError, match="has the recorded run: give an empty folder"):
        run_evolved(STUDY5, tmp_path, only=only, to=made / "data", networks=networks)
    another = f"{name}/z_+_motion/1"  # as after an interrupt between the two
    run_evolved(STUDY5, tmp_path, only=[*only, another], to=made / "data", networks=networks)
    assert f"{another}: bit-identical" in capsys.readouterr().out
    (run,) = find_runs(STUDY5, only=only)
    was = recorded(STUDY5, run, made / "data") | {"returns": "other"}
    assert compare_run(run, was, tmp_path / "study5").startswith("differs in returns: mean ")


def test_c_that_sees_z_alone_drives_as_the_agent_does(made, networks):
    for sees in ("z", "z, h"):
        sense = load(networks, made, "frame", sees)
        count = parameter_count(*sense.sizes)
        parameters = 0.1 * np.random.default_rng(0).standard_normal((3, count))
        if sees == "z":
            parameters[:, :-3].reshape(3, 3, -1)[..., sense.sizes[0] :] = 0
        agent = Agent(sense.world_model, parameters)
        expected = drive(agent, [5, 6, 7], max_frames=25).returns
        assert (sense.drive(parameters, [5, 6, 7], max_frames=25).returns == expected).all()


def test_the_motion_that_c_sees_is_the_true_motion():
    cars = Cars(2, "frame")
    cars.reset([3, 4])
    for _ in range(40):
        cars.step(np.array([[0.3, 0.8, 0], [-0.4, 0.9, 0]], np.float32))
    expected = [true_motion(cars, car)[COLUMNS] for car in (1, 0)]
    assert np.allclose(turning(cars, np.array([1, 0])), expected, atol=1e-5)


def test_what_is_added_is_seen_in_units_of_its_deviation_and_the_placebo_is_another_motion(
    made, networks
):
    motion, placebo = (load(networks, made, "frame", f"z + {one}") for one in ("motion", "placebo"))
    latents, numbers = np.zeros((4, motion.sizes[0])), np.arange(12.0).reshape(4, 3)
    seen = motion.features(latents, numbers)
    assert seen.shape == (4, motion.sizes[0] + 3) and (motion.scale > 0).all()
    assert np.allclose(seen[:, -3:] * motion.scale, numbers, atol=1e-4)
    length = len(placebo.others[1])
    assert (placebo.other_motion(3, 2) == placebo.others[1][2]).all()
    assert (placebo.other_motion(3, length + 2) == placebo.others[1][2]).all()


def test_erasure_leaves_no_linear_trace_and_the_placebo_takes_as_much_variance():
    rng = np.random.default_rng(0)
    mixing, motion = rng.standard_normal((3, 16)), rng.standard_normal((4000, 3))
    latents = (motion @ mixing + rng.standard_normal((4000, 16)) * np.linspace(0.1, 3, 16)).astype(
        np.float32
    )
    white = whiten(latents)
    directions = motion_directions(white, latents, motion)
    erased = erase(white, directions)(latents)
    covariance = (erased - erased.mean(axis=0)).T @ (motion - motion.mean(axis=0)) / len(motion)
    assert np.abs(covariance).max() < 1e-4
    variance = removed_variance(white, directions)
    placebo = random_directions(white, variance, rng)
    assert removed_variance(white, placebo) == pytest.approx(variance, rel=0.02)
    left = latents.var(axis=0).sum() - erase(white, placebo)(latents).var(axis=0).sum()
    assert left == pytest.approx(variance, rel=0.05)


def test_an_unknown_run_or_seed_is_refused():
    with pytest.raises(ValueError, match="has no seed 12"):
        find_runs(STUDY5, [12])
    with pytest.raises(ValueError, match="seed0/frame/y"):
        find_runs(STUDY5, only=["seed0/frame/y"])


def test_a_world_that_is_not_kept_is_named_before_anything_drives(tmp_path, monkeypatch):
    monkeypatch.setattr(study5, "prepare_seed", lambda *_: pytest.fail("drove"))
    with pytest.raises(
        FileNotFoundError, match=r"seed0/frame/world_model.safetensors is not there"
    ):
        run_evolved(STUDY5, tmp_path, [0], to=tmp_path / "data", networks=tmp_path)


def test_of_two_processes_one_prepares_a_seed_and_the_other_waits(
    made, networks, tmp_path, monkeypatch
):
    prepared = []

    def prepare_seed(seed, folder, _):
        prepared.append(seed)
        time.sleep(0.3)
        for variant in world_facts.SENSED_VARIANTS:
            copy_file(made / f"study5/seed0/{variant}" / WORLD_FILE, folder / variant)

    monkeypatch.setattr(study5, "prepare_seed", prepare_seed)
    runs = find_runs(STUDY5)[:2]
    with ThreadPoolExecutor(2) as both:
        list(both.map(lambda run: study5.prepare(run, tmp_path, networks), runs))
    assert prepared == [0]


def test_the_pilot_of_the_erasure_is_one_command(capsys, monkeypatch):
    monkeypatch.setattr(world_facts.measure_erasure, "__defaults__", (12, 2))
    monkeypatch.setattr(probe_run, "AGENT_FRAMES", 360)
    assert main(["erasure", "cropped_input_output"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    read, erased = (
        next(one for one in lines if one[:2] == ["trained", "agent:"] and one[2:-4] == sees)
        for sees in (["z"], ["z", "-", "motion"])
    )
    assert float(read[-3]) > 0.5 > 0.3 > float(erased[-3])  # R2 of the yaw rate
