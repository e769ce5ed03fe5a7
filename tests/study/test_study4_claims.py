"""Study 4: one agent of each variant, reported after the last run."""

import pandas
import pytest

from stad_lab.config import VARIANTS
from stad_study import tables
from stad_study.study4 import TRACKS, find_runs
from stad_study.study4_claims import describe_study4


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
    found = describe_study4(tmp_path)["agents"]
    assert set(found) == set(VARIANTS) and {one["seed"] for one in found.values()} == {402}
    assert {name for name, one in found.items() if one["reached"]} == {"input", "input_output"}
    assert found["frame"]["failures"] == 1 and found["frame"]["minimum"] == 700.0
    assert found["frame"]["scores"] == pytest.approx([937.4, 938.4, 939.4], abs=0.01)
    assert found["frame"]["mean"] == found["frame"]["scores"][-1]


def test_a_run_without_all_its_returns_is_refused(tmp_path):
    write_tables(tmp_path, find_runs(), lambda run: [900.0] * len(TRACKS))
    table = tables.read("study4_returns", tmp_path)
    tables.save("study4_returns", table.iloc[:-1], tmp_path)
    with pytest.raises(ValueError, match="study4_returns: expected a return of each run"):
        describe_study4(tmp_path)
