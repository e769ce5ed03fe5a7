"""The table: one command makes a row and goes on with it, and its interval covers the truth."""

import inspect
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from stad_lab.__main__ import main
from stad_lab.config import Settings
from stad_lab.evaluation.evaluate import bootstrap, evaluate
from stad_lab.io.files import checksum, load_json, save_json
from stad_lab.replication import run as replication
from stad_lab.replication.experiments import FLOORS, ROWS, Row
from stad_lab.replication.run import TRACKS, describe_time, keep, replicate, time_needed
from stad_lab.replication.tables import (
    WORLD_MODELS,
    bootstrap_gain,
    kept_rows,
    learning_curve,
    lost_points,
    stage_times,
    summarise_row,
)
from stad_lab.training.evolution import LOG, fitness_curves
from stad_lab.training.pipeline import starts, total_budget
from stad_lab.viz.plots import (
    plot_curves,
    plot_episodes,
    plot_intervals,
    plot_returns,
    plot_seeds,
    plot_stacks,
)

TINY = {"processes": 1, "generations": 2, "v_steps": 8, "m_steps": 4, "max_frames": 30}
FIRST = Settings.preset("quick", **TINY)
SECOND = Settings.preset("quick", **TINY | {"agent_episodes": 2, "generations": 4, "components": 8})


@pytest.fixture(scope="module")
def table(evaluate_briefly, tmp_path_factory):
    """A row of two rounds and two seeds, and one that shares its world: (the folder of both, their summaries)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ROWS, "two", Row("input", "two rounds", SECOND, FIRST, seeds=(0, 1)))
        patch.setitem(
            ROWS,
            "blind",
            Row(
                "input",
                "no M",
                Settings.preset("quick", **TINY, features="z"),
                seeds=(3,),
                world="one",
            ),
        )
        patch.setitem(ROWS, "one", Row("input", "one round", FIRST, seeds=(0,)))
        evaluate_briefly(patch)
        folder = tmp_path_factory.mktemp("table")
        with ThreadPoolExecutor(1) as executor:
            yield folder, {name: replicate(name, folder, executor) for name in ("two", "blind")}


def test_a_row_holds_a_search_for_every_seed_on_the_same_world(table):
    folder, _ = table
    files = [
        (folder / "two" / f"seed{seed}" / "autoencoder.safetensors").read_bytes() for seed in (0, 1)
    ]
    assert files[0] == files[1]
    logs = [load_json(folder / "two" / f"seed{seed}" / "evolution.json") for seed in (0, 1)]
    assert logs[0]["autoencoder"] == logs[1]["autoencoder"]
    assert logs[0]["generations"][0]["tracks"] != logs[1]["generations"][0]["tracks"]
    assert logs[0]["generations"][0]["mean_checksum"] != logs[1]["generations"][0]["mean_checksum"]


def test_where_the_searches_of_a_row_begin_is_found_once(table, tmp_path, capsys):
    folder, _ = table
    for part in ("world", "first"):
        shutil.copytree(folder / "two" / part, tmp_path / "two" / part)
    with ThreadPoolExecutor(1) as executor:
        for seed in (
            1,
            0,
        ):  # the other way round than in the table, so each finds once what it was given once
            capsys.readouterr()
            replicate("two", tmp_path, executor, seeds=[seed])
            assert ("components:" in capsys.readouterr().err) == (seed == 1)
    for seed in ("seed0", "seed1"):
        assert (tmp_path / "two" / seed / LOG).read_bytes() == (
            folder / "two" / seed / LOG
        ).read_bytes()


def test_a_search_begins_where_its_own_world_says_though_a_seed_of_another_training_lies_beside_it(
    table, tmp_path
):
    made, own = table[0] / "two", tmp_path / "two"
    shutil.copytree(made, own, ignore=shutil.ignore_patterns("seed1"))
    for name in ("autoencoder.safetensors", "components.safetensors", "start.safetensors"):
        (own / "seed0" / name).write_bytes(b"of another training")
    with ThreadPoolExecutor(1) as executor:
        replication.search(ROWS["two"], 1, own / "seed1", own / "first", own / "world", executor)
    assert (own / "seed1" / LOG).read_bytes() == (made / "seed1" / LOG).read_bytes()


def test_a_folder_beside_the_seeds_is_no_seed(table, tmp_path):
    for name in ("seed0", "seed0_old", "seed1.bak"):
        shutil.copytree(
            table[0] / "two" / "seed0",
            tmp_path / "two" / name,
            ignore=shutil.ignore_patterns("rollouts"),
        )
    assert kept_rows(tmp_path) == {"two": [tmp_path / "two" / "seed0"]}


def test_a_row_that_shares_a_world_trains_none_of_its_own(table):
    folder, _ = table
    assert {path.name for path in (folder / "blind").iterdir()} == {"seed3"}
    assert (folder / "one" / "world").is_dir() and not (folder / "one" / "seed0").exists()


def test_every_seed_of_a_retrained_row_is_a_whole_run_of_its_own(table, tmp_path, monkeypatch):
    monkeypatch.setitem(
        ROWS, "anew", Row("input", "whole runs", FIRST, seeds=(0, 1), retrained=True)
    )
    with ThreadPoolExecutor(1) as executor:
        found = replicate("anew", tmp_path, executor)
        assert replicate("anew", tmp_path, executor, seeds=[1])["seeds"] == found["seeds"][1:]
    logs = [load_json(tmp_path / "anew" / f"seed{seed}" / LOG) for seed in (0, 1)]
    assert logs[0]["autoencoder"] != logs[1]["autoencoder"]
    first = load_json(table[0] / "two" / "first" / LOG)  # of seed 0, with the same settings
    assert (
        first["autoencoder"] == logs[0]["autoencoder"]
        and first["generations"] == logs[0]["generations"]
    )
    assert found["episodes"] == 8 + 8 + 2 and len(keep("anew", tmp_path, tmp_path / "kept")) == 2
    monkeypatch.setattr(
        replication, "speeds", lambda *_: dict.fromkeys(("V, M, C", "official", "V", "M"), 100.0)
    )
    one, both = (time_needed("anew", seeds) for seeds in ([0], [0, 1]))
    assert both == {part: 2 * seconds for part, seconds in one.items()}


def test_what_is_there_is_not_done_again(table):
    folder, summaries = table
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    assert replicate("two", folder) == summaries["two"]
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()} == before


def test_a_lost_evaluation_is_driven_again_to_the_same_numbers(table):
    folder, summaries = table
    (folder / "two" / "seed1" / "evaluation.json").unlink()
    with ThreadPoolExecutor(1) as executor:
        assert replicate("two", folder, executor) == summaries["two"]


def test_an_evaluation_of_another_controller_is_driven_again(table):
    folder, summaries = table
    path = folder / "two" / "seed1" / "evaluation.json"
    whole = load_json(path)
    save_json(path, whole | {"controller_sha256": "of an earlier one", "episodes": []})
    with ThreadPoolExecutor(1) as executor:
        assert replicate("two", folder, executor) == summaries["two"]
    assert load_json(path)["controller_sha256"] == whole["controller_sha256"]


def test_the_summary_counts_every_episode_that_was_driven_for_a_seed(table):
    folder, summaries = table
    record = load_json(folder / "two" / "seed0" / "record.json")
    # 8 random ones, 2 generations of 4 agents and a look at 2 tracks; 2 by the agent, 4 generations and 2 looks.
    assert (
        summaries["two"]["episodes"] == 8 + 8 + 2 + 2 + 16 + 4 == total_budget(record)["episodes"]
    )
    assert summaries["two"]["agents"] == 8 + 16
    assert len(summaries["two"]["seeds"]) == 2 and summaries["blind"]["episodes"] == 8 + 8 + 2


def test_a_learning_curve_ends_at_all_the_episodes_of_its_seed(table):
    folder, summaries = table
    curves = [learning_curve(folder / "two" / f"seed{seed}") for seed in (0, 1)]
    for episodes, scores in curves:
        assert (
            episodes.tolist() == [8 + 8 + 2 + 2 + 8 + 2, summaries["two"]["episodes"]]
            and len(scores) == 2
        )
    figure = plot_episodes({"two": curves}, {"World Models (v0)": WORLD_MODELS}, "Score")
    (axis,) = figure.axes
    assert axis.get_xscale() == "log" and axis.get_xlim()[1] > 1_800_000
    assert (
        figure.get_label()
        == f"Score. At the end, mean of the seeds: two {np.mean([c[1][-1] for c in curves]):.0f}."
    )


def test_no_row_is_left_out_of_a_figure_however_many_there_are():
    rows = [f"row {number}" for number in range(25)]
    fair = plot_episodes(
        {name: [(np.array([1, 2]), np.array([3, 4]))] for name in rows}, {}, "Score"
    )
    seeds = plot_seeds({name: np.zeros((1, 3, 6)) for name in rows}, "Evolution")
    lines = plot_curves({name: np.arange(3) for name in rows}, "Lines", "x", "y", marker="o")
    for axis in (fair.axes[0], seeds.axes[0], lines.axes[0]):
        assert axis.get_legend_handles_labels()[1] == rows
    returns = plot_returns({name: np.arange(3) for name in rows}, "Returns")
    assert len(returns.axes[0].collections) == len(rows)


def test_a_band_goes_from_the_lowest_to_the_highest_seed_and_each_is_a_line_in_it(table):
    logs = [load_json(table[0] / "two" / f"seed{seed}" / "evolution.json") for seed in (0, 1)]
    curves = np.stack([fitness_curves(log["generations"]) for log in logs])
    figure = plot_seeds({"two": curves}, "Evolution", window=2)
    for panel, axis in enumerate(figure.axes):
        smooth = (curves[:, panel, 1:] + curves[:, panel, :-1]) / 2
        band = axis.collections[0].get_paths()[0].vertices[:, 1]
        assert (band.min(), band.max()) == pytest.approx((smooth.min(), smooth.max()))
        assert axis.lines[0].get_ydata() == pytest.approx(smooth.mean(axis=0))
        assert np.array([line.get_ydata() for line in axis.lines[1:3]]) == pytest.approx(smooth)


def test_a_run_shorter_than_the_window_is_drawn_at_its_mean():
    figure = plot_seeds({"short": np.full((2, 3, 4), 100.0)}, "Evolution")
    assert [axis.lines[0].get_ydata().tolist() for axis in figure.axes] == [[100.0]] * 3


def test_only_finished_seeds_are_kept_and_they_say_the_same(table, tmp_path):
    folder, summaries = table
    kept = keep("two", folder, tmp_path)
    assert [path.name for path in kept] == ["seed0", "seed1"] and summarise_row(kept) == summaries[
        "two"
    ]
    assert keep("one", folder, tmp_path) == []
    sizes = [path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()]
    assert (
        len(sizes) == 2 * 4 + 4 + 2 and max(sizes) < 200_000
    )  # neither V nor M; a first round is not evaluated
    histories = load_json(tmp_path / "two" / "world" / "histories.json")
    assert (
        histories["mdn_rnn"][-1]["step"]
        == load_json(kept[0] / "record.json")["settings"]["m_steps"]
    )
    assert (tmp_path / "two" / "first" / "evolution.json").read_bytes() == (
        folder / "two" / "first" / "evolution.json"
    ).read_bytes()


def test_a_seed_that_was_made_elsewhere_joins_the_row_and_its_world_that_of_seed_0(table, tmp_path):
    folder, summaries = table
    for place, other in (("here", "seed1"), ("elsewhere", "seed0")):
        shutil.copytree(
            folder / "two",
            tmp_path / place / "two",
            ignore=shutil.ignore_patterns(other, "rollouts"),
        )
    kept = tmp_path / "kept"
    for place, seed in (("here", "seed0"), ("elsewhere", "seed1")):
        assert [path.name for path in keep("two", tmp_path / place, kept)] == [seed]
    assert (
        summarise_row(kept_rows(kept)["two"]) == summaries["two"]
        and summaries["two"]["worlds"] == 1
    )
    assert sorted(path.name for path in (kept / "two").iterdir()) == [
        "first",
        "seed0",
        "seed1",
        "world",
    ]
    trained, log = (
        {"variant": "of another training"},
        tmp_path / "elsewhere" / "two" / "seed1" / "evolution.json",
    )
    save_json(tmp_path / "elsewhere" / "two" / "world" / "record.json", trained)
    save_json(log, load_json(log) | {"autoencoder": "of another training"})
    keep("two", tmp_path / "elsewhere", kept)
    assert summarise_row(kept_rows(kept)["two"])["worlds"] == 2
    assert load_json(kept / "two" / "world" / "record.json") == load_json(
        folder / "two" / "world" / "record.json"
    )
    assert (
        load_json(kept / "two" / "world_of_seed1" / "record.json")["variant"] == trained["variant"]
    )
    first = [kept / "two" / place / "evolution.json" for place in ("first", "first_of_seed1")]
    assert load_json(first[0]) == load_json(first[1])  # a copy here; another training's elsewhere


def test_the_times_of_a_row_are_those_of_all_its_stages_in_both_rounds(table, tmp_path):
    folder = table[0] / "two"
    times = stage_times(folder)
    assert list(times) == ["rollouts", "autoencoder", "mdn_rnn", "controller", "evaluation"]
    for stage in ("rollouts", "autoencoder", "mdn_rnn"):
        spent = [
            load_json(folder / part / "record.json")["seconds"][stage]
            for part in ("first", "world")
        ]
        assert times[stage] == sum(spent) > max(spent)
    keep("two", table[0], tmp_path)
    assert stage_times(tmp_path / "two") == times


def test_the_time_needed_is_measured_on_this_machine_and_says_what_takes_how_long(monkeypatch):
    monkeypatch.setitem(
        ROWS, "one", Row("input", "one round", Settings.preset("quick", width=4, v_batch=128))
    )
    times = time_needed("one")
    assert all(times[part] > 0 for part in ("rollouts", "V", "M", "searches", "evaluations"))
    assert (
        times["first search"] == 0 and times["evaluations"] > times["searches"]
    )  # whole episodes against brief ones
    line = describe_time("one", times)
    assert line.startswith("one: at most ") and "searches" in line and "first search" not in line


def test_every_row_has_the_budget_that_the_table_promises():
    for name, row in ROWS.items():
        before = ROWS[row.base] if row.base else row
        rounds = [
            settings
            for settings in (before.first, before.settings, row.base and row.settings)
            if settings
        ]
        agents = sum(settings.generations * settings.population for settings in rounds)
        looks = sum(
            settings.generations // settings.validate_every * settings.validation_tracks
            for settings in rounds
        )
        driven = sum(
            settings.generations * settings.population * settings.tracks for settings in rounds
        )
        episodes = row.settings.episodes + row.settings.agent_episodes + driven + looks
        if name != "long_input":  # which asks what more would bring
            assert agents <= 4800 and (
                name.startswith(("paper", "finished")) or episodes <= 4800
            ), (
                name,
                agents,
                episodes,
            )
        if row.base:
            assert (
                (agents, episodes) == (4000, 8594)
                and before.variant == row.variant
                and before.seeds == row.seeds
            )
    assert {
        row.variant
        for name, row in ROWS.items()
        if name.startswith("two_rounds") and len(row.seeds) >= 3
    } == {
        "frame",
        "input",
        "output",
        "input_output",
    }


def test_the_interval_covers_the_truth_more_often_than_one_over_tracks_alone():
    rng, hits, narrow = np.random.default_rng(1), [], []
    for _ in range(40):
        returns = 900 + 15 * rng.standard_normal((5, 1)) + 60 * rng.standard_normal((5, 100))
        low, high = bootstrap(returns, resamples=1000)
        hits.append(low < 900 < high)
        spread = 1.96 * returns.std() / np.sqrt(returns.size)
        narrow.append(abs(returns.mean() - 900) < spread)
    assert np.mean(hits) > 0.8 > np.mean(narrow)


def test_the_interval_of_a_gain_shares_the_tracks_and_covers_the_luck_of_both_searches():
    rng, hits, narrow = np.random.default_rng(0), [], []
    tracks = 900 + 60 * rng.standard_normal(100)
    assert bootstrap_gain(tracks[None], tracks[None] + 5) == pytest.approx([5, 5])  # on every track
    for _ in range(40):
        lucks = 15 * rng.standard_normal((2, 5, 1)) + 10 * rng.standard_normal((2, 5, 100))
        before, after = tracks + lucks[0], tracks + 10 + lucks[1]
        low, high = bootstrap_gain(before, after, resamples=1000)
        hits.append(low < 10 < high)
        low, high = bootstrap_gain(
            before.mean(axis=0)[None], after.mean(axis=0)[None], resamples=1000
        )
        narrow.append(low < 10 < high)
    assert np.mean(hits) > 0.8 > 0.4 > np.mean(narrow)


def test_an_unknown_row_ends_in_one_line_that_names_the_rows(capsys, tmp_path):
    assert main(["replicate", "--row", "papers", "--out", str(tmp_path)]) == 2
    assert (
        "error: unknown row 'papers': choose one of paper_frame, paper_input"
        in capsys.readouterr().err
    )


def test_an_unknown_seed_ends_in_one_line_that_names_the_seeds(capsys, tmp_path):
    assert (
        main(["replicate", "--row", "one_round", "--out", str(tmp_path), "--seeds", "1", "7"]) == 2
    )
    assert "error: row 'one_round' has no seed 7: choose of 0, 1, 2" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_some_seeds_of_a_row_can_be_made_alone(table, monkeypatch):
    folder, summaries = table
    assert replicate("two", folder, seeds=[1, 1])["seeds"] == summaries["two"]["seeds"][1:]
    speeds = {"V, M, C": 10.0, "V": 10.0, "M": 10.0, "official": 10.0}
    monkeypatch.setattr(
        replication, "speeds", lambda *_: speeds
    )  # measured twice they would differ
    whole, one = time_needed("one_round"), time_needed("one_round", seeds=[2])
    for part, share in {"rollouts": 1, "V": 1, "M": 1, "searches": 3, "evaluations": 3}.items():
        assert whole[part] == pytest.approx(share * one[part])
    base, finished = (
        time_needed(f"{recipe}_frame", seeds=[0]) for recipe in ("two_rounds", "finished")
    )
    longer = (15 * 32 * 8 + 3 * 16) / (40 * 64 + 8 * 16)
    assert finished == base | {
        "finishes": base["searches"] * longer,
        "evaluations": 2 * base["evaluations"],
    }
    assert (
        time_needed("untrained_M")["M"] == whole["M"] > 0
    )  # the world that it shares has a trained M


def test_seeds_that_are_kept_one_after_the_other_leave_one_record_of_their_training(
    table, tmp_path
):
    without_0 = tmp_path / "without_0" / "two"
    shutil.copytree(table[0] / "two", without_0, ignore=shutil.ignore_patterns("seed0", "rollouts"))
    for source in (table[0], without_0.parent):  # with seed 0 beside it, and from another machine
        kept = tmp_path / "kept" / source.name
        assert [path.name for path in keep("two", source, kept, seeds=[1])] == ["seed1"]
        keep("two", table[0], kept)
        assert {path.name for path in (kept / "two").iterdir()} == {
            "first",
            "world",
            "seed0",
            "seed1",
        }


def test_the_command_keeps_what_is_finished(tmp_path, capsys):
    assert main(["replicate", "--row", "one_round", "--out", str(tmp_path), "--keep"]) == 0
    assert "no seed is finished" in capsys.readouterr().out


def test_the_command_prints_the_finished_seeds_of_rows_anywhere_and_draws_them_beside_the_claim(
    table, tmp_path, capsys
):
    records = tmp_path / "records"
    shutil.copytree(table[0] / "two", records / "two", ignore=shutil.ignore_patterns("rollouts"))
    (records / "two" / "seed1" / "evaluation.json").unlink()
    picture = tmp_path / "claims.png"
    assert main(["table", "--records", str(records), "--picture", str(picture)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and lines[3].startswith(f"drawn to {picture}: Claimed and found")
    assert lines[2].startswith(f"| `two` | 1 of 2 | 1 | {table[1]['two']['seeds'][0]:.1f} |")
    assert "input_output the paper, v0 902." in Image.open(picture).text["Description"]


@pytest.mark.parametrize("options", [["--records", "empty"], ["--picture", "claims.jpg"]])
def test_a_table_that_cannot_be_made_ends_in_one_line_before_anything_is_written(
    options, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main(["table", "--picture", "claims.png", *options]) == 2
    told = capsys.readouterr()
    assert told.err.startswith(f"error: {' '.join(options)}: expected a f") and not told.out
    assert not any(tmp_path.iterdir())


def test_a_driver_that_does_not_look_is_a_row_like_any_other(tmp_path, monkeypatch):
    monkeypatch.setattr(replication, "TRACKS", 3)
    with ThreadPoolExecutor(1) as executor:
        found = {name: replicate(name, tmp_path, executor) for name in FLOORS}
    for name, row in found.items():
        told = load_json(tmp_path / name / "seed0" / "evaluation.json")
        assert [episode["track"] for episode in told["episodes"]] == [0, 1, 2] and told[
            "mean"
        ] == row["mean"] < 200
        assert row["episodes"] == 0 and keep(name, tmp_path, tmp_path / "kept")
        assert replicate(name, tmp_path) == row and "evaluations" in describe_time(
            name, time_needed(name)
        )
    assert found["random_driver"]["mean"] != found["gentle_driver"]["mean"]
    for ask in (replicate, keep):
        with pytest.raises(ValueError, match="row 'random_driver' is no search and has no seeds"):
            ask("random_driver", tmp_path, seeds=[0])


def test_lost_points_tell_slow_laps_from_waiting_for_the_end_after_a_missed_tile(tmp_path):
    drives = [
        (930.0, 700),
        (910.0, 900),
        (896.0, 1000),
        (-130.0, 300),
    ]  # two laps, a missed tile, out of the field
    save_json(
        tmp_path / "evaluation.json", {"episodes": [{"return": r, "frames": f} for r, f in drives]}
    )
    lost = lost_points([tmp_path])
    assert lost == pytest.approx({"speed": 80.0, "waiting": 72.5 - 80.0, "tiles": (4 + 1100) / 4})
    assert 1000 - sum(lost.values()) == pytest.approx(np.mean([episode for episode, _ in drives]))
    figure = plot_stacks({"agent": {"speed": 80.0, "tiles": 276.0}}, "Lost", "points")
    assert figure.get_label() == "Lost. agent: speed 80, tiles 276."


def test_an_agent_without_a_complete_lap_has_its_time_as_speed(tmp_path):
    save_json(tmp_path / "evaluation.json", {"episodes": [{"return": 500.0, "frames": 1000}]})
    assert lost_points([tmp_path]) == {"speed": 100.0, "waiting": 0.0, "tiles": 400.0}


def test_every_panel_of_intervals_shows_all_its_values():
    panels = {
        "one": {"a": {"claimed": (75.0, [75.0, 75.0])}},
        "two": {"a": {"here": (-20.0, [-30.0, -10.0])}},
    }
    figure = plot_intervals(panels, "Gain", "points")
    for axis in figure.axes:
        low, high = axis.get_xlim()
        assert low < -30 and high > 75
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["claimed", "here"]


def test_every_row_that_we_report_holds_its_protocol():
    kept = kept_rows()
    assert set(FLOORS) <= set(kept)
    for name, folders in kept.items():
        for folder in folders:
            told, record = load_json(folder / "evaluation.json"), load_json(folder / "record.json")
            assert [episode["track"] for episode in told["episodes"]] == list(range(100))
            assert not any(start["uncommitted_changes"] for start in starts(record))
            if name in ROWS:
                row = ROWS[name].settings_of(int(folder.name.removeprefix("seed")))
                assert record["settings"] == row.as_dict() and told["renderer"] == "official"
                assert told["controller_sha256"] == checksum(
                    (folder / "controller.safetensors").read_bytes()
                )
                if (
                    ROWS[name].base
                    and (base := folder.parents[1] / ROWS[name].base / folder.name).exists()
                ):
                    assert record["earlier"] == load_json(base / "record.json")
                spent, more = total_budget(record), name.startswith(("paper", "finished"))
                if name != "long_input":  # which asks what more would bring
                    assert spent["agents"] <= 4800 and (spent["episodes"] <= 4800 or more)


def test_a_row_is_driven_on_the_official_tracks_with_gymnasium_s_renderer(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        replication, "evaluate", lambda *given, **named: asked.append((given, named)) or {}
    )
    (tmp_path / "controller.safetensors").write_bytes(b"C")
    replication.evaluate_row(ROWS["paper_input"], tmp_path, None)
    call = inspect.signature(evaluate).bind(*asked[0][0], **asked[0][1])
    call.apply_defaults()
    assert [call.arguments[name] for name in ("episodes", "first_track", "fast")] == [
        replication.TRACKS,
        0,
        False,
    ]
    assert TRACKS == 100  # as it was before a fixture shortened it
    assert call.arguments["unfinished"].parent == tmp_path  # so an interrupted evaluation goes on
