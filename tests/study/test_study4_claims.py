"""Study 4: one agent of each variant, reported after the last run."""

import re
import sys
from pathlib import Path

import pandas
import pytest

from stad_lab.config import VARIANTS
from stad_lab.io.files import load_json
from stad_lab.training.record import RECORD
from stad_study import tables
from stad_study.networks import NETWORKS
from stad_study.study import STUDIES
from stad_study.study4 import SEEDS, TRACKS, VALIDATION, controller_of, find_runs
from stad_study.study4_claims import describe_study4

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import blocks


def write_tables(folder, runs, returns_of):
    """Tables in which a run's validation is its seed, and `returns_of` gives its returns."""
    for name in ("runs", "returns"):
        lines = []
        for run in runs:
            returns = returns_of(run)
            made = {"mean": sum(returns) / len(returns), "validation": float(run.seed)}
            made |= {"processor": "a CPU", "controller": "c"}
            columns = dict(zip(map(str, TRACKS), returns, strict=True))
            lines.append(run._asdict() | (made if name == "runs" else columns))
        tables.save(f"study4_{name}", pandas.DataFrame(lines), folder)


def write_shipped(folder, means):
    """The table of agents that were shipped before, and score `means`."""
    made = {"processor": "a CPU", "controller": "c"}
    lines = [
        {"variant": one, **made, **dict.fromkeys(map(str, TRACKS), means[one])} for one in means
    ]
    tables.save("study4_shipped", pandas.DataFrame(lines), folder)


def test_of_each_variant_the_agent_with_the_best_validation_is_reported_after_the_last_run(
    tmp_path,
):
    lowest = {"frame": 700.0, "input": 850.0, "output": 850.0, "input_output": 800.0}

    def returns_of(run):
        usual = 940.0 - (402 - run.seed) - 20 * (run.variant == "output")
        return [lowest[run.variant], *[usual] * (len(TRACKS) - 1)]

    write_tables(tmp_path, find_runs()[:-1], returns_of)
    assert describe_study4(tmp_path) == {"runs": 11, "planned": 12}
    write_tables(tmp_path, find_runs(), returns_of)
    assert describe_study4(tmp_path) == {"runs": 12, "planned": 12}  # the shipped ones are to drive
    write_shipped(tmp_path, dict.fromkeys(VARIANTS, 930.0))
    found = describe_study4(tmp_path)["agents"]
    assert set(found) == set(VARIANTS) and {one["seed"] for one in found.values()} == {402}
    assert {name for name, one in found.items() if one["reached"]} == {"input", "input_output"}
    assert found["frame"]["failures"] == 1 and found["frame"]["minimum"] == 700.0
    assert found["frame"]["scores"] == pytest.approx([937.4, 938.4, 939.4], abs=0.01)
    assert found["frame"]["mean"] == found["frame"]["scores"][-1]


@pytest.mark.parametrize(("mean_of_frame", "replaced"), [(919.0, True), (921.0, False)])
def test_the_shipped_agents_are_replaced_all_together_if_their_mean_is_lower(
    tmp_path, mean_of_frame, replaced
):
    write_tables(tmp_path, find_runs(), lambda run: [920.0] * len(TRACKS))
    write_shipped(tmp_path, dict.fromkeys(VARIANTS, 920.0) | {"frame": mean_of_frame})
    found = describe_study4(tmp_path)
    assert found["shipped"]["frame"] == mean_of_frame and found["replaced"] is replaced
    claims = {"study4": found}
    told = "replaced, all together" if replaced else "kept"
    assert blocks.strongest(claims).endswith(
        f"The four agents that were shipped before are {told}."
    )
    assert "The goal is reached by none." in blocks.strongest(claims)


def test_where_the_chosen_agents_fail_is_told_of_each(tmp_path):
    failures = {"frame": 3, "input": 1, "output": 0, "input_output": 0}

    def returns_of(run):
        count = failures[run.variant]
        return [700.0] * count + [920.0] * (len(TRACKS) - count)

    write_tables(tmp_path, find_runs(), returns_of)
    write_shipped(tmp_path, dict.fromkeys(VARIANTS, 930.0))
    found = describe_study4(tmp_path)
    assert found["places"] == {}  # none is listed yet
    assert "| 3 | not listed | 930.0 |" in blocks.strongest({"study4": found})
    lines = [("frame", 6000, 120.0, "drives back"), ("frame", 6001, -95.0, "drives back")]
    lines += [("frame", 6002, 20.0, "drives on"), ("input", 6000, 89.0, "leaves the field")]
    names = ["variant", "track", "bend", "then"]
    table = pandas.DataFrame(lines, columns=names).assign(seed=402, points=1.0, tile=5, speed=60.0)
    tables.save("study4_failures", table.iloc[:-1], tmp_path)
    assert describe_study4(tmp_path)["places"] == {}  # nor all
    tables.save("study4_failures", table, tmp_path)
    found = describe_study4(tmp_path)
    assert found["places"]["frame"] == {
        "failures": 3,
        "at a sharp bend": 2,
        "speed": 60.0,
        "then": {"drives back": 2, "drives on": 1},
    }
    told = blocks.strongest({"study4": found})
    assert re.search(r"`frame` .* \| 2 \| 930\.0 \|", told)
    assert told.endswith("the car drives back (2), drives on (1), leaves the field (1).")


def test_a_run_without_all_its_returns_is_refused(tmp_path):
    write_tables(tmp_path, find_runs(), lambda run: [900.0] * len(TRACKS))
    write_shipped(tmp_path, dict.fromkeys(VARIANTS, 900.0))
    table = tables.read("study4_returns", tmp_path)
    tables.save("study4_returns", table.iloc[:-1], tmp_path)
    with pytest.raises(ValueError, match="study4_returns: expected a return of each run"):
        describe_study4(tmp_path)


def test_study_4_has_the_seeds_tracks_and_limits_of_the_protocol():
    assert [*SEEDS] == [400, 401, 402] and VALIDATION == 64
    assert [*TRACKS] == [*range(6000, 6400)] and STUDIES["study1"].max_frames == 1000


def test_of_each_variant_the_agent_with_the_best_validation_is_kept():
    runs = tables.read("study4_runs")
    for variant, own in runs.groupby("variant"):
        best = own.loc[own["validation"].idxmax()]
        assert controller_of(NETWORKS / "study4" / variant)["controller"] == best["controller"]
        record = load_json(NETWORKS / "study4" / variant / RECORD)
        assert (record["variant"], record["config"]["seed"]) == (variant, best["seed"])
