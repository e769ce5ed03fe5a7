"""The study: the real command measures what is shipped, goes on where it stopped, and its record is reported."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.__main__ import main
from stad_lab.agent import PRETRAINED, read_world_model
from stad_lab.config import Settings
from stad_lab.evaluation.trajectories import MOTION, record_random_drive
from stad_lab.io.files import load_json
from stad_lab.models.mdn_rnn import fit_mdn_rnn
from stad_lab.models.vae import VARIANTS, AutoEncoder
from stad_lab.replication.study import (
    CONTENDERS,
    HORIZON,
    KL_WEIGHTS,
    PARTS,
    RECORD,
    STRIDES,
    compare,
    lesser_forecasts,
    probe_drives,
    probe_panels,
    probe_part,
    simple_forecasts,
    study,
)

SETTINGS = Settings.preset("quick", seed=5, episodes=12, random_starts=1.0)


def twelve_drives():
    """Drives of the random driver, recorded anew, since a test may change them."""
    return [record_random_drive(SETTINGS, index) for index in range(12)]


@pytest.fixture(scope="module")
def measured(quick_run, tmp_path_factory):
    """M's part of a study, by the real command on the quick run's rollouts: its folder."""
    folder = tmp_path_factory.mktemp("study")
    arguments = [
        "--settings",
        "quick",
        "--out",
        folder,
        "--rollouts",
        quick_run / "rollouts",
        "--part",
        "mdn_rnn",
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stad_lab.replication.study.DREAMERS", 6)
        patch.setattr("stad_lab.replication.study.VARIANTS", ("frame", "input"))
        assert main(["study", *map(str, arguments)]) == 0
    return folder


def test_the_command_measures_m_against_simple_forecasts_and_lesser_m_s(measured):
    result = json.loads((measured / "study.json").read_text(encoding="utf-8"))
    assert list(result["mdn_rnn"]["variants"]) == ["frame", "input"]
    nll = result["mdn_rnn"]["variants"]["input"]["nll"]
    assert set(CONTENDERS) < set(nll) and all(
        v["interval"][0] <= v["nats"] <= v["interval"][1] for v in nll.values()
    )
    assert nll["M"]["nats"] < nll["repeat the last z"]["nats"]
    for found in result["mdn_rnn"]["variants"].values():
        assert sum(found["pit"]) == pytest.approx(1) and len(found["horizon"]["one dream"]) == len(
            HORIZON
        )


def test_a_study_goes_on_where_it_stopped_with_the_same_numbers(
    measured, quick_run, interrupt_after
):
    world_model = read_world_model(PRETRAINED / "input", "input")
    rng = np.random.default_rng(0)
    z, actions = rng.standard_normal((4, 20, 32), np.float32), rng.random((4, 20, 3), np.float32)
    arguments = (
        Settings.preset("quick"),
        quick_run / "rollouts",
        measured,
        world_model,
        z,
        actions,
    )
    first = lesser_forecasts(*arguments)
    kept = (measured / "one_Gaussian" / "mdn_rnn.safetensors").stat().st_mtime_ns
    shutil.rmtree(measured / "no_memory")
    hook = interrupt_after(11)  # between two checkpoints
    with pytest.raises(KeyboardInterrupt):
        lesser_forecasts(*arguments)
    hook.remove()
    assert list(measured.glob("no_memory/*.training.safetensors"))
    again = lesser_forecasts(*arguments)
    assert all(np.array_equal(first[name], again[name]) for name in CONTENDERS)
    otherwise = lesser_forecasts(*arguments[:-1], 1 - actions)
    assert [name for name in CONTENDERS if np.array_equal(first[name], otherwise[name])] == [
        "no actions"
    ]
    assert (measured / "one_Gaussian" / "mdn_rnn.safetensors").stat().st_mtime_ns == kept
    assert not list(measured.glob("*/*.training.safetensors"))


def test_the_m_without_actions_is_trained_without_them_and_no_other(
    quick_run, tmp_path, monkeypatch
):
    shown = {}

    def fit(path, *given):
        shown[path.parent.name] = np.concatenate(given[4])
        return fit_mdn_rnn(path, *given)

    monkeypatch.setattr("stad_lab.replication.study.fit_mdn_rnn", fit)
    world_model = read_world_model(PRETRAINED / "input", "input")
    z, actions = np.zeros((4, 20, 32), np.float32), np.zeros((4, 20, 3), np.float32)
    lesser_forecasts(
        Settings.preset("quick", m_steps=2),
        quick_run / "rollouts",
        tmp_path,
        world_model,
        z,
        actions,
    )
    assert [name for name, seen in shown.items() if not seen.any()] == ["no_actions"] and len(
        shown
    ) == 3


def test_every_stride_and_weight_of_the_kl_is_trained_and_measured(
    quick_run, tmp_path, monkeypatch
):
    drives = twelve_drives()
    monkeypatch.setattr("stad_lab.replication.study.random_drives", lambda *given: drives)
    monkeypatch.setattr("stad_lab.replication.study.agent_drives", lambda *given: drives)
    monkeypatch.setattr("stad_lab.replication.study.AGENT_SKIP", 8)
    monkeypatch.setattr("stad_lab.replication.study.VARIANTS", ("frame",))
    monkeypatch.setattr("stad_lab.replication.study.STRIDES", (1, 4))
    monkeypatch.setattr("stad_lab.replication.study.KL_WEIGHTS", (0.25, 4.0))
    parts = ["probe", "bar", "autoencoder"]
    found = study(Settings.preset("quick", v_steps=4), quick_run / "rollouts", tmp_path, parts)
    for driver in ("random driver", "trained agent"):
        assert set(found["probe"]["variants"][driver]) == {
            "frame",
            "frame, untrained",
            "input_output, untrained",
        }
        assert set(found["probe"]["strides"][driver]) == {"1", "4"}
        bar, probe = (found[part]["variants"][driver] for part in ("bar", "probe"))
        assert (
            bar.keys() == probe.keys() and bar["frame"] != probe["frame"]
        )  # two V's, with the bar and without
    assert set(found["autoencoder"]["rate_distortion"]) == {"0.25", "4"}
    trained = {path.parent.name for path in tmp_path.glob("*/autoencoder.safetensors")}
    assert trained == {
        "stride_1",
        "stride_4",
        "kl_weight_4",
    }  # a stride of 4 and a weight of 0.25 are the same V


def test_an_m_of_another_v_or_of_other_settings_is_not_taken_for_one_of_this_study(
    measured, quick_run
):
    world_model = read_world_model(PRETRAINED / "input", "input")
    rollouts, nothing = quick_run / "rollouts", np.zeros((4, 20, 32), np.float32)
    another = world_model._replace(identities=world_model.identities | {"autoencoder": "another"})
    with pytest.raises(ValueError, match=r"mdn_rnn\.safetensors was made with another autoencoder"):
        lesser_forecasts(Settings.preset("quick"), rollouts, measured, another, nothing, nothing)
    for change in ({"hidden_size": 9}, {"m_steps": 9}):
        with pytest.raises(ValueError, match=next(iter(change))):
            lesser_forecasts(
                Settings.preset("quick", **change),
                rollouts,
                measured,
                world_model,
                nothing,
                nothing,
            )


def test_a_part_that_is_measured_is_kept_if_the_next_is_interrupted(tmp_path, monkeypatch):
    def stop(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(
        "stad_lab.replication.study.PARTS",
        {"autoencoder": lambda *given: {"found": 1}, "probe": stop},
    )
    monkeypatch.setattr("stad_lab.replication.study.random_drives", lambda *given: [])
    arguments = [
        "--settings",
        "quick",
        "--out",
        tmp_path,
        "--part",
        "autoencoder",
        "--part",
        "probe",
    ]
    assert main(["study", *map(str, arguments)]) == 130
    assert load_json(tmp_path / "study.json")["autoencoder"]["found"] == 1


def test_an_unknown_part_is_refused_before_any_work(tmp_path):
    with pytest.raises(
        ValueError, match="unknown part 'probes': choose from probe, bar, autoencoder, mdn_rnn"
    ):
        study(Settings.preset("quick"), tmp_path / "rollouts", tmp_path, ["probes"])
    assert not any(tmp_path.iterdir())


def test_drives_are_probed_for_every_motion_and_shown_by_motion():
    drives = twelve_drives()
    found = probe_drives(
        drives, 8, AutoEncoder("input_output", width=4), {}, SETTINGS.stride, SETTINGS.crop_bar
    )
    assert list(found) == ["z"] and set(found["z"]) == set(MOTION)
    panels = probe_panels({"untrained": found})
    assert panels["yaw rate"]["untrained"]["z"][0] == found["z"]["yaw rate"]["r2"]


def test_the_first_frames_of_a_drive_do_not_count_in_a_probe():
    drives = twelve_drives()
    asked = (8, AutoEncoder("input_output", width=4), {}, SETTINGS.stride, SETTINGS.crop_bar)
    found = probe_drives(drives, *asked)
    for drive in drives:
        drive.motion[:8, list(MOTION).index("yaw rate")] = 1e3
    assert probe_drives(drives, *asked) == found


def test_simple_forecasts_are_fitted_on_the_first_half_of_the_drives_alone():
    rng = np.random.default_rng(0)
    z, actions = rng.standard_normal((6, 20, 4), np.float32), rng.random((6, 20, 3), np.float32)
    found = simple_forecasts(z, actions)
    z[3:] *= 10
    for name, nll in simple_forecasts(z, actions).items():
        assert np.array_equal(nll[:3], found[name][:3]) and not np.allclose(
            nll[3:], found[name][3:]
        )


def test_forecasts_are_compared_on_the_same_frames_and_on_active_latents():
    nll = np.ones((6, 149, 3))
    nll[:, :3] = 100  # frames that a forecast from the last four z's cannot have
    nll[..., 2] = 50  # a latent that tells nothing
    nll[:3] = -7  # drives that the simple forecasts were fitted on
    found = compare({"M": nll, "longer": nll[:, 3:] + 0.5}, np.array([True, True, False]))
    assert found["M"]["nats"] == 1 and found["longer"]["nats"] == 1.5
    assert found["longer"]["more_than_M"] == [0.5, 0.5] and found["M"]["more_than_M"] == [0, 0]


def test_the_shipped_record_is_a_whole_study_of_what_is_shipped():
    record = load_json(RECORD)
    assert set(record) == set(PARTS)
    for part in record.values():
        assert part["settings"]["name"] == "laptop" and part["drives"] == 180
        assert part["made_with"]["commit"] and not part["made_with"]["uncommitted_changes"]
    for driver in [*record["probe"]["variants"].values(), *record["bar"]["variants"].values()]:
        assert set(VARIANTS) < set(driver) and any("untrained" in source for source in driver)
        assert all(
            list(driver[variant]) == ["z", "z, h", "z, h of an untrained M"] for variant in VARIANTS
        )
    assert all(
        list(found) == [str(stride) for stride in STRIDES]
        for found in record["probe"]["strides"].values()
    )
    assert list(record["autoencoder"]["rate_distortion"]) == [
        f"{weight:g}" for weight in KL_WEIGHTS
    ]
    assert (
        set(record["autoencoder"]["variants"])
        == set(record["mdn_rnn"]["variants"])
        == set(VARIANTS)
    )


def test_every_v_is_probed_with_its_own_stride(monkeypatch, tmp_path):
    asked, room = [], "stad_lab.replication.study."
    monkeypatch.setattr(
        room + "shorter_autoencoder", lambda *given, stride: f"V of stride {stride}"
    )
    monkeypatch.setattr(room + "two_drivers", lambda *given: {"random driver": ([], 8)})
    monkeypatch.setattr(room + "probe_variants", lambda *given: {})
    monkeypatch.setattr(room + "probe_drives", lambda *given: asked.append((given[2], given[4])))
    probe_part(Settings.preset("quick"), tmp_path, tmp_path, [])
    assert asked == [(f"V of stride {stride}", stride) for stride in STRIDES]


def test_the_command_probes_v_and_m_of_a_run_and_keeps_every_r2_with_its_interval(
    quick_run, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(
        "stad_lab.replication.study.AGENT_FRAMES", 120
    )  # in the workers, too: they are threads
    monkeypatch.setattr(
        "stad_lab.replication.study.worker_processes", lambda count: ThreadPoolExecutor(1)
    )
    file, before = tmp_path / "probe.json", sorted(quick_run.iterdir())
    arguments = ["--variant", "input_output", "--path", quick_run, "--drives", "12", "--json", file]
    assert main(["probe", *map(str, arguments)]) == 0
    found, printed = load_json(file), capsys.readouterr().out
    assert {"autoencoder": found["autoencoder"], "mdn_rnn": found["mdn_rnn"]} == read_world_model(
        quick_run, "input_output"
    ).identities
    assert list(found["drivers"]) == ["random driver", "trained agent"] and found["drives"] == 12
    for driver, by_features in found["drivers"].items():
        assert driver in printed and list(by_features) == ["z", "z, h"]
        for r2s in by_features.values():
            assert list(r2s) == list(MOTION)
            assert all(
                one["interval"][0] <= one["r2"] <= one["interval"][1] <= 1 for one in r2s.values()
            )
            assert "".join(f"{one['r2'] + 0.0:16.2f}" for one in r2s.values()) in printed
    assert sorted(quick_run.iterdir()) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--drives", "11"], "drives=11: expected at least 12"),
        (["--variant", "both"], "unknown variant 'both'"),
        (["--path", "nowhere"], "nowhere"),
    ],
)
def test_a_probe_that_cannot_be_made_is_refused_before_any_drive(
    change, message, quick_run, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "stad_lab.replication.study.random_drives", lambda *given: pytest.fail("a drive began")
    )
    assert main(["probe", "--variant", "input_output", "--path", str(quick_run), *change]) == 2
    assert message in capsys.readouterr().err and not any(tmp_path.iterdir())


def test_frames_without_a_road_in_sight_do_not_count_in_a_probe():
    settings = Settings.preset("quick", seed=5, episodes=12, random_starts=1.0)
    drives = [record_random_drive(settings, index) for index in range(12)]
    asked = (8, AutoEncoder("input_output", width=4), {}, settings.stride, settings.crop_bar)
    for drive in drives:
        drive.motion[20:25, list(MOTION).index("road offset")] = 9.0
    found = probe_drives(drives, *asked)
    for drive in drives:
        drive.motion[20:25, list(MOTION).index("yaw rate")] = 1e3
    assert probe_drives(drives, *asked) == found
