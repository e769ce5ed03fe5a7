"""The statistics of study 5: effects are found, and tables with a gap are refused."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest

from stad_study import tables
from stad_study.claims import read_claims
from stad_study.evolved import find_runs
from stad_study.study5 import STUDY5
from stad_study.study5_claims import describe_study5

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import blocks

EFFECTS = {"z + motion": 40, "z + placebo": 15, "z + action": 35}  # points
EFFECTS |= {"z - motion": -40, "z - placebo": -15}


def write_tables(folder, runs):
    """Tables in which motion earns 25 points more than a placebo, and input_output another 20."""
    rng, lines = np.random.default_rng(0), []
    for run in runs:
        mean = 800 + EFFECTS.get(run.sees, 0) + 20 * (run.variant == "input_output")
        returns = mean + rng.normal(0, 5) + rng.normal(0, 20, 400)
        columns = {str(1000 + track): one for track, one in enumerate(returns)}
        curve = {"validation.5": mean - 100 - run.repeat, "validation.10": mean}
        lines.append((run._asdict(), columns | curve | {"mean": returns.mean()}))
    made = {"processor": "a CPU", "controller": "c"}
    for name in ("runs", "returns"):
        table = pandas.DataFrame([key | found | made for key, found in lines])
        tables.save(f"study5_{name}", table, folder)


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """A folder with the tables of all runs."""
    folder = tmp_path_factory.mktemp("complete")
    write_tables(folder, find_runs(STUDY5))
    return folder


@pytest.fixture(scope="module")
def described(complete):
    """Study 5 after its last run."""
    return describe_study5(complete)


@pytest.mark.parametrize(
    ("column", "number", "message"),
    [("mean", 0.0, "mean and returns differ"), ("validation.5", np.nan, "every validation")],
)
def test_a_line_of_runs_that_does_not_fit_is_refused(complete, tmp_path, column, number, message):
    shutil.copytree(complete, tmp_path, dirs_exist_ok=True)
    table = tables.read("study5_runs", tmp_path)
    table.loc[5, column] = number
    tables.save("study5_runs", table, tmp_path)
    with pytest.raises(ValueError, match=message):
        describe_study5(tmp_path)


@pytest.mark.parametrize("spoil", ["a return is missing", "a track is missing", "a run is missing"])
def test_a_table_with_a_gap_is_refused(complete, tmp_path, spoil):
    shutil.copytree(complete, tmp_path, dirs_exist_ok=True)
    table = tables.read("study5_returns", tmp_path)
    if spoil == "a return is missing":
        table.loc[5, "1007"] = np.nan
    elif spoil == "a track is missing":
        del table["1007"]
    else:
        table = table.drop(index=5)
    tables.save("study5_returns", table, tmp_path)
    with pytest.raises(
        ValueError, match="expected a return of each run on the tracks 1000 to 1399"
    ):
        describe_study5(tmp_path)


def test_a_run_that_is_missing_is_named(tmp_path):
    write_tables(tmp_path, find_runs(STUDY5)[:-1])
    with pytest.raises(ValueError, match=r"the run .*, 3\) is not in the tables"):
        describe_study5(tmp_path)


def test_the_learning_curve_of_an_arm_is_averaged_over_its_runs(described):
    arms = described["arms"]
    assert arms["frame: z + motion"]["curve"]["mean"] == [738, 840]
    assert arms["input_output: z"]["curve"]["low"] == [718, 820]
    assert arms["input_output: z"]["processors"] == {"a CPU": 36}


def test_effects_are_found_and_corrected_within_their_family(described):
    found = described["comparisons"]
    expected = {"interaction": 0, "input_output less input": 20, "both with motion": 20}
    expected |= {"effect with z": 20, "effect with z and h": 20}
    expected |= {"adding motion": 25, "erasing motion": -25, "remembering the action": 20}
    for name, points in expected.items():
        assert found[name]["difference"] == pytest.approx(points, abs=8), name
        assert len(found[name]["by_seed"]) == 12
    assert found["adding motion"]["verdict"] == "gain"
    assert found["erasing motion"]["verdict"] == "harm"
    pair = [found[name] for name in ("interaction", "input_output less input")]
    low, high = sorted(pair, key=lambda one: one["p"])
    assert low["holm_p"] == pytest.approx(2 * low["p"]) and high["holm_p"] >= high["p"]
    assert found["interaction"]["verdict"] == "no relevant difference"
    assert {"verdict", "p"}.isdisjoint(found["both with motion"])


def test_a_small_harm_is_marked_and_an_undecided_test_says_how_many_seeds_would_decide():
    one = {"difference": -15.0, "t_interval": [-25.0, -5.0], "p": 0.01, "holm_p": 0.02}
    small = one | {"interval": [-25.0, -5.0], "verdict": "harm"}
    large = one | {"interval": [-45.0, -5.0], "verdict": "harm"}
    wide = one | {"interval": [-50.0, 10.0], "verdict": "undecided", "seeds_that_decide": 31}
    named = {"adding motion": small, "erasing motion": large, "interaction": wide}
    page = blocks.cause_table({"comparisons": named})
    assert page.count("harm, of fewer than 30 points |") == 1 and page.count("harm |") == 1
    assert "undecided (31 seeds) |" in page


def test_the_page_has_every_arm_and_difference_in_its_tables_and_figures(described):
    claims = {"study5": described, "study1": read_claims()["study1"]}
    page = blocks.cause(claims)
    assert "(#is-it-the-motion)" in blocks.verdict(claims)
    assert len([line for line in page.splitlines() if line.startswith("| `")]) == 11
    for name in ("study5", "study5_curves"):
        assert f"../notebooks/pictures/{name}.png" in page
    arms = (f"{variant}: z + motion" for variant in ("frame", "input_output"))
    frame, both = (f"{described['arms'][arm]['mean']:.0f}" for arm in arms)
    assert f"| C sees z + motion | {frame} | {both} |" in page
    assert re.search(r"\| C sees z - placebo \|  \| 8\d\d \|", page)
    panels = blocks.FIGURES["study5_curves"](claims).axes
    named = [[line.get_label() for line in panel.lines] for panel in panels]
    seen = "z", "z + motion", "z + placebo", "z + action"
    assert named[0] == [f"C sees {one}" for one in seen]
    seen = "z", "z - motion", "z - placebo", "z + motion"
    assert named[1] == [f"C sees {one}" for one in seen]
    assert list(panels[0].lines[1].get_ydata()) == [738, 840]
    axis = blocks.FIGURES["study5"](claims).axes[0]
    drawn = [list(line.get_xdata()) for line in axis.lines]
    for one in described["comparisons"].values():
        assert one["by_seed"] in drawn and one["interval"] in drawn
