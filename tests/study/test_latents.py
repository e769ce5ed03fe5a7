"""Latents: what is measured, with what, and that a study continues where it stopped."""

import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.agent import PRETRAINED
from stad_lab.cli import main as probe_command
from stad_lab.config import Config
from stad_lab.evaluation import probe_run
from stad_lab.evaluation.probe_run import Encoder, probe_trajectories
from stad_lab.evaluation.trajectories import MOTION, record_random_trajectory
from stad_lab.evaluation.trajectories import encode_trajectory as encode
from stad_lab.io.files import load_json
from stad_lab.io.weights import load_world_model
from stad_lab.models.vae import VAE
from stad_lab.training.mdn_rnn import fit_mdn_rnn
from stad_study import latents
from stad_study.cli import main
from stad_study.latents import (
    HORIZON,
    REDUCED,
    Given,
    compare_nll,
    measure,
    reduced_predictions,
    simple_predictions,
)

QUICK = Config.preset("quick")


@pytest.fixture
def driven():
    """Trajectories of the random driver, new ones for each test, since it may change them."""
    config = QUICK.replace(seed=5, data={"episodes": 12, "random_starts": 1.0})
    return [record_random_trajectory(config, index) for index in range(12)]


@pytest.fixture
def encoder():
    """An untrained V."""
    return Encoder(VAE("input_output", width=4), QUICK.vae.stride, QUICK.data.crop_bar, {})


@pytest.fixture(scope="module")
def measured(quick_run, tmp_path_factory):
    """The folder of a study of M, by the real command on the dataset of the quick run."""
    folder = tmp_path_factory.mktemp("study")
    command = ["latents", "--preset", "quick", "--out", folder, "--parts", "mdn_rnn"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(latents, "DREAMERS", 2)
        patch.setattr(latents, "VARIANTS", ("frame", "input"))
        assert main([*map(str, command), "--dataset", str(quick_run / "dataset")]) == 0
    return folder


@pytest.mark.parametrize("problem", ["--dataset is empty", "latents.json is damaged"])
def test_what_is_wrong_with_a_folder_is_said_before_any_work(
    problem, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "latents.json").write_text("{")
    empty = ["--dataset", ""] if problem.startswith("--dataset") else []
    assert main(["latents", "--preset", "quick", "--out", ".", *empty]) == 2
    assert problem in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["latents.json"]


@pytest.fixture
def reduced(measured, quick_run):
    """The arguments of `reduced_predictions`, on random z and actions."""
    rng, study = np.random.default_rng(0), Given(QUICK, quick_run / "dataset", measured, [])
    z, actions = rng.standard_normal((4, 20, 32), np.float32), rng.random((4, 20, 3), np.float32)
    return study, load_world_model(PRETRAINED / "cropped_input"), z, actions


def test_m_is_measured_beside_simple_predictions_and_reduced_m(measured):
    variants = load_json(measured / "latents.json")["mdn_rnn"]["variants"]
    assert list(variants) == ["frame", "input"]
    nll = variants["input"]["nll"]
    assert set(REDUCED) < set(nll) and not set(REDUCED) & set(variants["frame"]["nll"])
    assert all(one["interval"][0] <= one["nats"] <= one["interval"][1] for one in nll.values())
    assert nll["M"]["nats"] < nll["repeat the last z"]["nats"]
    for found in variants.values():
        assert sum(found["pit"]) == pytest.approx(1)
        assert len(found["horizon"]["one dream"]) == len(HORIZON)


def test_an_interrupted_study_continues_to_the_same_numbers(measured, reduced, interrupt_after):
    first = reduced_predictions(*reduced)
    kept = (measured / "one_Gaussian" / "mdn_rnn.safetensors").stat().st_mtime_ns
    shutil.rmtree(measured / "no_memory")
    with interrupt_after(11):  # between two checkpoints
        reduced_predictions(*reduced)
    assert list(measured.glob("no_memory/*.training.safetensors"))
    again = reduced_predictions(*reduced)
    assert all(np.array_equal(first[name], again[name]) for name in REDUCED)
    assert (measured / "one_Gaussian" / "mdn_rnn.safetensors").stat().st_mtime_ns == kept
    other = reduced_predictions(*reduced[:-1], 1 - reduced[-1])
    assert [name for name in REDUCED if np.array_equal(first[name], other[name])] == ["no actions"]


def test_one_reduced_m_alone_is_trained_without_actions(quick_run, reduced, tmp_path, monkeypatch):
    shown = {}

    def fit(config, data, path, device):
        shown[path.parent.name] = np.concatenate(data.actions)
        return fit_mdn_rnn(config, data, path, device)

    monkeypatch.setattr(latents, "fit_mdn_rnn", fit)
    brief = Given(QUICK.replace(mdn_rnn={"steps": 2}), quick_run / "dataset", tmp_path, [])
    reduced_predictions(brief, *reduced[1:])
    assert len(shown) == len(REDUCED)
    assert [name for name, actions in shown.items() if not actions.any()] == ["no_actions"]


def test_a_reduced_m_of_another_v_or_other_settings_is_refused(reduced):
    study, model, *data = reduced
    another = model._replace(checksums=model.checksums | {"vae": "another"})
    with pytest.raises(ValueError, match="another"):
        reduced_predictions(study, another, *data)
    for field in ("hidden_size", "steps"):
        changed = Given(QUICK.replace(mdn_rnn={field: 9}), study.dataset, study.work, [])
        with pytest.raises(ValueError, match=field):
            reduced_predictions(changed, model, *data)


def test_every_variant_stride_and_kl_weight_is_measured(quick_run, tmp_path, driven, monkeypatch):
    monkeypatch.setattr(latents, "random_trajectories", lambda *given: driven)
    monkeypatch.setattr(latents, "two_drivers", lambda *given: {"random driver": (driven, 8)})
    monkeypatch.setattr(latents, "VARIANTS", ("frame",))
    monkeypatch.setattr(latents, "STRIDES", (1, 4))
    strides = []
    monkeypatch.setattr(
        probe_run, "encode_trajectory", lambda *given: strides.append(given[2]) or encode(*given)
    )
    monkeypatch.setattr(latents, "KL_WEIGHTS", (0.25, 4.0))
    config = QUICK.replace(vae={"steps": 4})
    found = measure(config, quick_run / "dataset", tmp_path, ["probe", "vae"])
    probed = found["probe"]["drivers"]["random driver"]
    names = ["cropped_frame", "frame", "frame, untrained", "input_output, untrained"]
    assert list(probed) == [*names, "stride 1", "stride 4"]
    assert list(probed["frame"]) == ["z", "z, h", "z, h of an untrained M"]
    assert list(probed["stride 1"]) == ["z"] and probed["frame"] != probed["cropped_frame"]
    assert set(found["vae"]["rate_distortion"]) == {"0.25", "4"}
    assert set(strides[-24:-12]) == {1} and set(strides[-12:]) == {4}  # V sees its own stride
    trained = {path.parent.name for path in tmp_path.glob("*/vae.safetensors")}
    assert trained == {"stride_1", "stride_4", "kl_weight_4"}  # stride 4 has the weight 0.25


def test_a_measured_part_is_kept_if_the_next_one_is_interrupted(tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    parts = {"vae": lambda _: {"found": 1}, "probe": interrupted}
    monkeypatch.setattr(latents, "PARTS", parts)
    monkeypatch.setattr(latents, "random_trajectories", lambda *given: [])
    command = ["latents", "--preset", "quick", "--out", str(tmp_path), "--parts", "vae", "probe"]
    assert main(command) == 130
    assert load_json(tmp_path / "latents.json")["vae"]["found"] == 1


def test_an_unknown_part_is_refused_before_any_work(tmp_path):
    with pytest.raises(ValueError, match="unknown part 'probes': choose from probe, vae, mdn_rnn"):
        measure(QUICK, tmp_path / "dataset", tmp_path, ["probes"])
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("cause", ["first frames", "no road in sight"])
def test_frames_that_cannot_show_the_motion_do_not_count_in_a_probe(cause, driven, encoder):
    place, quantities = slice(0, 8), list(MOTION)
    if cause == "no road in sight":
        place = slice(20, 25)
        for one in driven:
            one.motion[place, quantities.index("road offset")] = 9.0
    found = probe_trajectories(driven, 8, encoder)
    assert list(found) == ["z"] and list(found["z"]) == quantities
    for one in driven:
        one.motion[place, quantities.index("yaw rate")] = 1e3
    assert probe_trajectories(driven, 8, encoder) == found


def test_simple_predictions_are_fitted_on_the_first_half_of_the_trajectories():
    rng = np.random.default_rng(0)
    z, actions = rng.standard_normal((6, 20, 4), np.float32), rng.random((6, 20, 3), np.float32)
    found = simple_predictions(z, actions)
    z[3:] *= 10
    for name, nll in simple_predictions(z, actions).items():
        assert np.array_equal(nll[:3], found[name][:3])
        assert not np.allclose(nll[3:], found[name][3:])


def test_predictions_are_compared_on_the_same_frames_and_on_active_latents():
    nll = np.ones((6, 149, 3))
    nll[:, :3] = 100  # frames that a prediction from the last four z lacks
    nll[..., 2] = 50  # an inactive latent
    nll[:3] = -7  # trajectories that the simple predictions were fitted on
    found = compare_nll({"M": nll, "longer": nll[:, 3:] + 0.5}, np.array([True, True, False]))
    assert found["M"]["nats"] == 1 and found["longer"]["nats"] == 1.5
    assert found["longer"]["more_than_M"] == [0.5, 0.5] and found["M"]["more_than_M"] == [0, 0]


def test_the_command_probes_a_run_and_keeps_every_r2(quick_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(probe_run, "AGENT_FRAMES", 120)
    monkeypatch.setattr(probe_run, "worker_threads", lambda count: ThreadPoolExecutor(1))
    file, before = tmp_path / "probe.json", sorted(quick_run.iterdir())
    command = ["probe", "--run", quick_run, "--episodes", "12", "--json", file]
    assert probe_command([*map(str, command)]) == 0
    found, printed = load_json(file), capsys.readouterr().out
    checksums = load_world_model(quick_run).checksums
    assert {name: found[name] for name in ("vae", "mdn_rnn")} == checksums
    assert list(found["drivers"]) == ["random driver", "trained agent"]
    for driver, by_features in found["drivers"].items():
        assert driver in printed and list(by_features) == ["z", "z, h"]
        for r2s in by_features.values():
            assert list(r2s) == list(MOTION)
            assert "".join(f"{one['r2']:z16.2f}" for one in r2s.values()) in printed
            for one in r2s.values():
                assert one["interval"][0] <= one["r2"] <= one["interval"][1] <= 1
    assert sorted(quick_run.iterdir()) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--episodes", "11"], "episodes=11: expected at least 12"),
        (["--run", "nowhere"], "nowhere"),
    ],
)
def test_a_probe_that_cannot_be_made_is_refused_before_any_episode(
    change, message, quick_run, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(probe_run, "random_trajectories", lambda *given: pytest.fail("an episode"))
    options = {"--run": str(quick_run), **dict([change])}
    assert probe_command(["probe", *(word for pair in options.items() for word in pair)]) == 2
    assert message in capsys.readouterr().err and not any(tmp_path.iterdir())
