"""Claims: nothing is stale, and the findings that the pages rest on."""

import json

import numpy as np
import pandas
import pytest

from stad_lab.config import VARIANTS, flatten
from stad_lab.replication import claims, measurements


def test_the_committed_file_is_what_the_tables_give():
    # To 9 digits, since the last ones of a mean depend on the processor.
    texts = json.dumps(claims.compute_claims()), claims.CLAIMS.read_text(encoding="utf-8")
    fresh, kept = (
        json.loads(text, parse_float=lambda digits: f"{float(digits):.9g}") for text in texts
    )
    assert fresh == kept


def test_the_findings_of_the_pages_hold():
    found = claims.read_claims()
    verdict, agents, yaw_rate = (found[part] for part in ("verdict", "agents", "yaw_rate_of_z"))
    assert verdict["word"] == verdict["no_bar"]["outcome"] == "open"
    assert not verdict["paper"]["baseline_passes"]
    assert not verdict["two_iterations"]["has_room"] and not verdict["fine_tuned"]["has_room"]
    low, high = verdict["no_bar"]["interval"]
    assert low < 0 and verdict["claimed_gain"] < high
    for recipe in found["recipes"].values():
        assert all(recipe[variant]["interval"][0] < 0 for variant in VARIANTS[1:])
    assert yaw_rate["input_output"]["lowest"] > 0.8 and yaw_rate["others"]["highest"] < 0.25
    assert all(agents[variant]["mean"] > 905 for variant in VARIANTS)
    assert agents["frame"]["failed"] == 0 and agents["cropped_input"]["mean"] < 900
    assert 0.006 < found["final_sigma"]["geometric_mean"] < 0.007


@pytest.mark.parametrize(
    ("recipes", "word"),  # of each: the mean of `frame`, and the interval of the difference
    [
        ([(500, 10, 90)], "open"),  # the baseline fails
        ([(830, 10, 90)], "supported"),
        ([(830, -50, 50), (930, 10, 90)], "contradicted"),  # the second has no room
        ([(830, -50, 50), (830, 10, 90)], "open"),
    ],
)
def test_a_verdict_follows_from_the_recipes_that_can_test_the_claim(recipes, word):
    found = {
        place: {"frame": {"mean": frame}, "input_output": {"difference": 0, "interval": interval}}
        for place, (frame, *interval) in enumerate(recipes)
    }
    assert claims.find_verdict(found, 940)["word"] == word


def test_lost_points_add_up_and_a_learning_curve_counts_every_episode():
    lost = measurements.lost_points(np.array([950.0, 700.0]), np.array([500, 1000]))
    assert lost == {"speed": 50, "waiting": 25, "tiles": 100}
    run = {"experiment": "a", "role": "run", "seed": 0}
    evolution = {"population": 4, "tracks": 2, "validation_tracks": 3}
    spent = {"total.episodes": 119, "budget.evolution.episodes": 16}
    spent["budget.validation.episodes"] = 3
    runs = pandas.DataFrame([run | spent | flatten(evolution, "config.evolution.")])
    log = pandas.DataFrame({"generation": [1, 2], "validation.mean": [np.nan, 7.0]}).assign(**run)
    assert [part.tolist() for part in claims.learning_curve(runs, log, "a", 0)] == [[119], [7]]
