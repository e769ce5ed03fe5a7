"""The statistics of the studies, on synthetic tables, against SciPy and known answers."""

import itertools
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest
from scipy import stats

from stad_lab.evaluation import statistics
from stad_lab.evaluation.trajectories import MOTION
from stad_study import study_claims, tables
from stad_study.claims import read_claims
from stad_study.study import STUDIES, find_pipelines
from stad_study.study_claims import FEATURES, describe_study1, describe_study3, leave_one_out

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import blocks

GAIN = {"frame": 0, "input": 5, "output": -60, "input_output": 40}  # points, and a speed
TRACKS, SEEDS = 400, 12


def returns_of(seed, variant, features):
    """Returns (tracks,) whose mean differs from that of `frame` by about GAIN."""
    rng = np.random.default_rng([seed, list(GAIN).index(variant), FEATURES.index(features)])
    hard = np.random.default_rng(9).normal(0, 40, TRACKS)
    seed_effect = np.random.default_rng([7, seed]).normal(0, 20)
    scatter = rng.normal(0, 8) + rng.normal(0, 30, TRACKS)
    return 850 + GAIN[variant] + hard + seed_effect + scatter


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A folder with the tables of a whole study, which nobody has run."""
    folder, episodes, generations, runs = tmp_path_factory.mktemp("tables"), [], [], []
    for one in find_pipelines("study1"):
        key, scores = one._asdict(), returns_of(one.seed, one.variant, one.features)
        lines = {"track": range(1000, 1400), "return": scores, "length": 1000}
        episodes.append(pandas.DataFrame(lines).assign(**key))
        curve = np.array([100.0, 300.0, 500.0]) + GAIN[one.variant] + one.seed
        log = {"generation": range(1, 7), "episodes": 900 + 80 * np.arange(1, 7)}
        log |= {"validation": np.where(np.arange(6) % 2, np.repeat(curve, 2), np.nan)}
        log |= dict.fromkeys(("worst", "mean", "best", "sigma", "frames"), 1)
        generations.append(pandas.DataFrame(log).assign(**key))
        made = {"world_model.trained_on": "cuda, a GPU" if one.seed > 8 else "cpu"}
        runs.append(key | made | {"processor": "p", "dataset": "d", "kept_controller": "c"})
    tables.save("study_episodes", pandas.concat(episodes), folder)
    tables.save("study_generations", pandas.concat(generations), folder)
    tables.save("study_runs", pandas.DataFrame(runs), folder)
    return folder


@pytest.fixture(scope="module")
def found(full):
    """The claims of the whole study."""
    return describe_study1(full)


def by_seed(variant, features):
    """Mean returns of the synthetic pipelines (seeds,)."""
    return np.array([returns_of(seed, variant, features).mean() for seed in range(SEEDS)])


def test_p_values_are_those_of_scipy_with_the_correction_of_holm(found):
    comparisons = found["comparisons"]
    families = ("input_output",), ("input", "output")
    assert len(comparisons) == 6
    for family in families:
        names = list(itertools.product(FEATURES, family))
        p = [
            stats.ttest_rel(by_seed(variant, features), by_seed("frame", features)).pvalue
            for features, variant in names
        ]
        order, adjusted = np.argsort(p), {}
        for rank, place in enumerate(order):  # Holm's definition
            adjusted[place] = max(
                min(1, (len(p) - other) * p[order[other]]) for other in range(rank + 1)
            )
        for place, (features, variant) in enumerate(names):
            one = comparisons[f"{features}: {variant}"]
            assert one["p"] == pytest.approx(p[place])
            assert one["holm_p"] == pytest.approx(adjusted[place])
            expected = by_seed(variant, features) - by_seed("frame", features)
            assert one["by_seed"] == pytest.approx(expected.tolist())
            assert one["difference"] == pytest.approx(expected.mean())


def test_a_verdict_that_one_seed_decides_is_another_without_it():
    rng = np.random.default_rng(0)
    returns = {f"{features}: frame": np.full((SEEDS, 40), 800.0) for features in FEATURES}
    returns["z: input_output"] = 840 + rng.normal(0, 5, (SEEDS, 40))
    returns["z, h: input_output"] = 828 + rng.normal(0, 5, (SEEDS, 40))
    returns["z, h: input_output"][3] -= 230
    found = leave_one_out(returns)
    assert found["z"] == ["gain"] * SEEDS
    assert found["z, h"][3] == "gain" and found["z, h"].count("undecided") == SEEDS - 1


def test_equivalence_is_where_the_interval_of_90_percent_lies_within_the_margin():
    rng = np.random.default_rng(0)
    found = []
    for shift in range(0, 40, 2):
        differences = rng.normal(shift, 25, 12)
        low, high = statistics.mean_interval(differences, 0.1)
        within = low > -30 and high < 30
        assert (statistics.equivalence_p(differences, 30) < 0.05) == within
        found.append(within)
    assert any(found) and not all(found)


def test_holm_is_known_for_four_tests():
    assert statistics.holm([0.03, 0.005, 0.04, 0.01]) == pytest.approx([0.06, 0.02, 0.06, 0.03])


def test_an_interval_resamples_seeds_and_tracks_of_the_paired_differences():
    rng = np.random.default_rng(0)
    differences = rng.normal(0, 20, (12, 1)) + rng.normal(0, 50, (1, 400)) + np.zeros((12, 400))
    low, high = statistics.bootstrap(differences)
    of_seeds, of_tracks = (differences.mean(axis=axis).std() for axis in (1, 0))
    error = np.sqrt(of_seeds**2 / 12 + of_tracks**2 / 400)  # the parts are independent
    assert high - low == pytest.approx(2 * 1.96 * error, rel=0.05)
    assert (low + high) / 2 == pytest.approx(differences.mean(), abs=0.05 * error)


@pytest.mark.parametrize(
    ("interval", "p", "verdict"),
    [
        ([4, 50], 0.01, "gain"),
        ([4, 50], 0.06, "undecided"),
        ([4, 25], 0.01, "gain"),  # also within the margin
        ([4, 25], 0.06, "no relevant gain"),
        ([-29, 29], 0.9, "no relevant gain"),
        ([-31, 10], 0.3, "undecided"),
        ([-50, -4], 0.01, "harm"),
        ([-5, 45], 0.04, "undecided"),
    ],
)
def test_a_verdict_follows_from_interval_and_p(interval, p, verdict):
    assert study_claims.find_verdict(interval, p) == verdict


def test_the_verdicts_of_a_study_are_those_that_its_tables_were_made_for(found):
    for features in FEATURES:
        verdicts = [
            found["comparisons"][f"{features}: {one}"]["verdict"] for one in GAIN if GAIN[one]
        ]
        assert verdicts == ["no relevant gain", "harm", "gain"]


@pytest.mark.parametrize("tests", [2, 4])
def test_the_number_of_seeds_that_decide_does_so_for_every_mean(tests):
    pairs = statistics.pairs_that_decide(32, 30, tests)
    assert 15 < pairs < 30
    scatter = np.random.default_rng(0).standard_normal(pairs)
    scatter = 32 * (scatter - scatter.mean()) / scatter.std(ddof=1)
    for mean in np.linspace(-45, 45, 61):
        p = min(1, tests * statistics.paired_p(scatter + mean))
        interval = statistics.mean_interval(scatter + mean)
        assert study_claims.find_verdict(interval, p) != "undecided"


def test_the_secondary_outcomes_of_an_arm_are_those_of_its_episodes(found, full):
    every = np.array([returns_of(seed, "output", "z") for seed in range(SEEDS)])
    arm, flat = found["arms"]["z: output"], np.sort(every.ravel())
    assert arm["below_800"] == (flat < 800).mean() and arm["minimum"] == flat[0]
    assert arm["tenth_percentile"] == np.percentile(flat, 10)
    assert arm["interquartile_mean"] == pytest.approx(flat[1200:3600].mean())
    # 100, 300, 500 at equal distances: the mean height is 300, more by the gain and the seed.
    curves = study_claims.learning_curves(full)["z: output"]
    areas = [300 - 60 + seed for seed in range(SEEDS)]
    assert study_claims.area_under(*curves) == pytest.approx(areas)
    assert arm["area"] == pytest.approx(np.mean(areas))
    assert found["comparisons"]["z: output"]["area_difference"] == pytest.approx(-60)
    curve = study_claims.over_episodes(*curves)
    assert curve["episodes"] == [1060, 1220, 1380]
    assert curve["mean"] == pytest.approx([45.5, 245.5, 445.5])


def test_nothing_is_tested_before_the_last_pipeline_is_there(full, tmp_path):
    for name in ("episodes", "generations", "runs"):
        table = tables.read_study(name, full)
        last = (table.seed == 11) & (table.variant == "output") & (table.features == "z, h")
        tables.save(f"study_{name}", table[~last], tmp_path)
    assert describe_study1(tmp_path) == {
        "complete_seeds": 11, "planned_seeds": 12, "pipelines": 95, "planned_pipelines": 96,
        "trained_on": {"cpu": 36, "cuda, a GPU": 12},
    }  # fmt: skip
    assert describe_study1(tmp_path / "empty")["pipelines"] == 0


def test_the_pages_have_every_result_of_the_study(found):
    claims = {"study1": found, "study5": read_claims()["study5"]}
    numbers = [blocks.NUMBERS[name](claims) for name in ("networks of a GPU", "trained networks")]
    assert numbers == [12, 48]
    page = blocks.study1(claims)
    for name, one in found["comparisons"].items():
        features, variant = name.split(": ")
        start = f"`{variant}`, {blocks.SEEN[features]} |"
        line = next(line for line in page.splitlines() if start in line)
        p = blocks.p_value(one["holm_p"])
        assert blocks.difference_of(one) in line and f"| {p} | {one['verdict']} |" in line
    gain = found["comparisons"]["z: input_output"]["difference"]
    assert f"({gain:.0f} points)" in blocks.gains(claims)
    assert blocks.verdict(claims).count("\n- ") == 4
    assert "](../notebooks/pictures/study1.png)" in page
    assert "](notebooks/pictures/study1_primary.png)" in blocks.verdict_figure(claims)
    assert "](../notebooks/pictures/study1_curves.png)" in blocks.outcomes(claims)


@pytest.mark.parametrize("missing", [1, TRACKS])  # episodes of the first pipeline
def test_a_pipeline_without_all_its_episodes_is_refused(full, tmp_path, missing):
    for name in ("generations", "runs"):
        tables.save(f"study_{name}", tables.read_study(name, full), tmp_path)
    tables.save("study_episodes", tables.read_study("episodes", full)[missing:], tmp_path)
    with pytest.raises(ValueError, match="study1: expected one episode of each pipeline"):
        describe_study1(tmp_path)


def test_r2_has_a_value_for_each_seed_and_an_interval_of_their_mean(tmp_path):
    keys = itertools.product(("frame", "input"), FEATURES, range(3), ("agent",), MOTION)
    columns = ["variant", "features", "seed", "driver", "quantity"]
    table = pandas.DataFrame(list(keys), columns=columns).assign(study="study1", trained=True)
    table["r2"] = 0.1 * table.seed + 0.3 * (table.features == "z, h")
    control = table[table.variant == "frame"].assign(trained=False, r2=0.01)
    tables.save("study_probe", pandas.concat([table, control]), tmp_path)
    found = describe_study3(tmp_path)
    assert (found["seeds"], found["planned_seeds"], found["networks"]) == (3, 12, 6)
    one = found["agent: frame"]["z, h"]["yaw rate"]
    assert one["values"] == pytest.approx([0.3, 0.4, 0.5])
    expected = stats.t.interval(0.95, 2, loc=0.4, scale=0.1 / 3**0.5)
    assert one["interval"] == pytest.approx(expected)
    assert found["agent: frame, untrained"]["z"]["yaw rate"]["values"] == [0.01] * 3
    assert list(found)[3:] == ["agent: frame", "agent: input", "agent: frame, untrained"]
    assert describe_study3(tmp_path / "empty")["seeds"] == 0


def test_the_planned_numbers_are_those_of_the_protocol():
    study = STUDIES["study1"]
    assert list(study.seeds) == list(range(12)) and study.tracks == range(1000, 1400)
    assert study_claims.FAMILIES == {"primary": ("input_output",), "secondary": ("input", "output")}
    assert (study_claims.MARGIN, study_claims.LEVEL) == (30, 0.05)
