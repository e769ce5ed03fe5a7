"""Tables: records go in and come out exact, and wrong ones are refused."""

import shutil

import pytest

from stad_lab.io.files import load_json, save_json
from stad_study import tables
from stad_study.claims import PRETRAINED


@pytest.fixture
def run(tmp_path):
    """The folder of a run."""
    return shutil.copytree(PRETRAINED / "frame", tmp_path / "run")


def test_a_run_is_added_once_and_read_exactly(run, tmp_path):
    for seed in (0, 1, 0):
        tables.add_run(run, "fine_tuned_frame", seed, tmp_path)
    driven = [one["return"] for one in load_json(run / "evaluation.json")["episodes"]]
    returns = tables.returns_of(tables.episodes(tmp_path))
    assert returns["fine_tuned_frame"].tolist() == [driven, driven]
    log = load_json(run / "evolution.json")["generations"]
    assert tables.read("generations", tmp_path)["sigma"].tolist() == [g["sigma"] for g in log] * 2
    assert tables.read("runs", tmp_path)["config.evolution.tracks"].tolist() == [8, 8]


def test_a_run_without_a_known_commit_is_added_and_continued_ones_are_counted(run, tmp_path):
    record = load_json(run / "record.json")
    record["made_with"]["commit"] = None
    record["continued_with"] = [record["made_with"], record["made_with"] | {"commit": "ab12"}]
    save_json(run / "record.json", record)
    tables.add_run(run, "fine_tuned_frame", 0, tmp_path)
    line = tables.read("runs", tmp_path).iloc[0]
    assert (line["commit"], line["continued_with"]) == ("unknown", "unknown ab12")


def test_a_table_that_could_not_be_read_again_is_not_written(run, tmp_path):
    tables.add_run(run, "fine_tuned_frame", 0, tmp_path)
    before = (tmp_path / "runs.csv").read_bytes()
    table = tables.read("runs", tmp_path)
    with pytest.raises(ValueError, match="column 'variant' is missing or has empty cells"):
        tables.save("runs", table.assign(variant=None), tmp_path)
    assert (tmp_path / "runs.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: {"renderer": "fast"}, "renderer is 'fast', expected 'gymnasium'"),
        (lambda _: {"variant": "input"}, "variant is 'input', expected 'frame'"),
        (lambda _: {"controller": "0"}, "controller is '0'"),
        (lambda _: {"mean": 950.0}, "mean=950"),
        (lambda episodes: {"episodes": episodes[:1] * 100}, "100 episodes on 1 tracks"),
        (
            lambda episodes: {"episodes": [one | {"track": one["track"] + 1} for one in episodes]},
            "tracks 0 to 99",
        ),
    ],
)
def test_an_evaluation_that_is_not_the_official_one_is_refused(run, tmp_path, change, message):
    evaluation = load_json(run / "evaluation.json")
    save_json(run / "evaluation.json", evaluation | change(evaluation["episodes"]))
    with pytest.raises(ValueError, match=message):
        tables.add_run(run, "fine_tuned_frame", 0, tmp_path)
    assert not list(tmp_path.glob("*.csv"))


def test_a_damaged_table_is_refused(tmp_path):
    for text, message in (
        ("experiment,seed,track,return\n", "'frames' is missing"),
        ("experiment,seed,track,return,frames\na,0,0,,9\n", "'return' is missing or has empty"),
        ("experiment,seed,track,return,frames\na,0,0,1,9\na,0,0,1,9\n", "more than one line"),
        ("experiment,seed,track,return,frames\na,0,0,1,9\n", "tracks 0 to 99"),
    ):
        (tmp_path / "episodes.csv").write_text(text)
        with pytest.raises(ValueError, match=message):
            tables.episodes(tmp_path)


def test_a_benchmark_takes_the_place_of_the_same_parts(tmp_path):
    for name in ("speed", "provenance"):
        shutil.copyfile(tables.DATA / f"{name}.csv", tmp_path / f"{name}.csv")
    row = {"median": 2.0, "rounds": [1.0, 2.0, 3.0], "ratio": 1.0}
    result = {"kind": "benchmark", "made_with": {"commit": "c0ffee", "python": "3.11"}, "rounds": 3}
    result |= {"loop": {"frames a second": {"one": row}, "costs": {"V": 5.5, "equal": True}}}
    save_json(tmp_path / "benchmark.json", result)
    before = tables.read("speed", tmp_path)
    for _ in range(2):
        tables.add_speed(tmp_path / "benchmark.json", tmp_path)
    after = tables.read("speed", tmp_path)
    assert after[after.part == "loop"].value.tolist() == [5.5, 1, 1, 2, 3]
    others = [table[table.part != "loop"].reset_index(drop=True) for table in (before, after)]
    assert others[0].equals(others[1])
    for commit, told in (("c0ffee", "c0ffee"), (None, "unknown")):  # outside a git checkout
        result["made_with"]["commit"] = commit
        save_json(tmp_path / "benchmark.json", result)
        tables.add_speed(tmp_path / "benchmark.json", tmp_path)
        made_with = tables.read("provenance", tmp_path)
        line = made_with[(made_with.table == "speed") & (made_with.source == "loop")]
        assert line.commit.tolist() == [told]
    assert {"run", "cluster"} <= set(made_with[made_with.table == "speed"].source)
