"""The test of study 6: computed after the last pair, and as SciPy computes it."""

import numpy as np
import pandas
import pytest
from scipy import stats

from stad_lab.training.pipeline import STAGES
from stad_study import tables
from stad_study.study import find_pipelines
from stad_study.study6_claims import RECIPES, describe_study6


def write_tables(folder, difference, without=None, wrong=()):
    """The tables of all pipelines but one, which nobody has run; returns the scores by recipe.

    `wrong` replaces values in the line of the last pipeline.
    """
    rng, episodes, runs, scores = np.random.default_rng(0), [], [], {}
    for recipe, gain in zip(RECIPES, (0, difference), strict=True):
        for one in find_pipelines(recipe):
            returns = 850 + gain + rng.normal(0, 20) + rng.normal(0, 5, 400)
            scores.setdefault(recipe, {})[one.seed, one.variant] = returns.mean()
            if (recipe, one.name) != without:
                lines = {"track": range(1000, 1400), "return": returns, "length": 1000}
                episodes.append(pandas.DataFrame(lines).assign(**one._asdict()))
                made = {"world_model.trained_on": "cpu", "processor": "p", "kept_controller": "c"}
                made |= {"dataset": f"d{one.seed}", "config.vae.steps": one.config.vae.steps}
                made |= {f"seconds.{stage}": 60 * (recipe == RECIPES[0]) + 60 for stage in STAGES}
                runs.append(one._asdict() | made)
    runs[-1] |= dict(wrong)
    tables.save("study_episodes", pandas.concat(episodes), folder)
    tables.save("study_runs", pandas.DataFrame(runs), folder)
    return scores


def test_nothing_is_tested_before_the_last_pair(tmp_path):
    write_tables(tmp_path, 0, without=("study6_fast", "seed205/input_output/z_h"))
    assert describe_study6(tmp_path) == {
        "pipelines": {"study6_laptop": 12, "study6_fast": 11},
        "planned": {"study6_laptop": 12, "study6_fast": 12},
    }


@pytest.mark.parametrize(("difference", "not_worse"), [(0, True), (-40, False)])
def test_the_bound_is_that_of_a_one_sided_paired_t_test(tmp_path, difference, not_worse):
    present, faster = write_tables(tmp_path, difference).values()
    found = describe_study6(tmp_path)
    pairs = [faster[key] - present[key] for key in present]
    test = stats.ttest_1samp(pairs, 0, alternative="greater")
    assert found["difference"] == pytest.approx(np.mean(pairs))
    assert found["lower_bound"] == pytest.approx(test.confidence_interval(0.95).low)
    assert found["not_worse"] is not_worse
    assert found["minutes"] == {"study6_laptop": 8, "study6_fast": 4}  # four stages
    by_seed = np.mean([pairs[::2], pairs[1::2]], axis=0)  # find_pipelines gives both variants
    low = stats.ttest_1samp(by_seed, 0, alternative="greater").confidence_interval(0.95).low
    assert found["lower_bound_of_seeds"] == pytest.approx(low)


def test_a_bound_of_exactly_the_margin_is_not_enough(tmp_path):
    write_tables(tmp_path, 0)
    table = tables.read("study_episodes", tmp_path)
    table["return"] = np.where(table["study"] == RECIPES[0], 850, 820)
    tables.save("study_episodes", table, tmp_path)
    assert describe_study6(tmp_path)["lower_bound"] == -30
    assert describe_study6(tmp_path)["not_worse"] is False


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"config.vae.steps": 5000}, "study6_fast/seed205/input_output/z_h has config.vae.steps"),
        ({"dataset": "d204"}, "seed 205 of study 6 has 2 datasets"),
    ],
)
def test_runs_that_are_not_a_pair_are_refused(tmp_path, wrong, message):
    write_tables(tmp_path, 0, wrong=wrong)
    with pytest.raises(ValueError, match=message):
        describe_study6(tmp_path)
