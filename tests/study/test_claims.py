"""Claims: nothing is stale, and the findings that the pages rest on."""

import json

import numpy as np

from stad_lab.config import VARIANTS
from stad_study import claims, measurements


def test_the_committed_file_is_what_the_tables_give():
    # To 9 digits, since the last ones of a mean depend on the processor.
    texts = json.dumps(claims.compute_claims()), claims.CLAIMS.read_text(encoding="utf-8")
    fresh, kept = (
        json.loads(text, parse_float=lambda digits: f"{float(digits):.9g}") for text in texts
    )
    assert fresh == kept


def test_the_findings_of_the_pages_hold():
    found = claims.read_claims()
    agents, earlier = found["agents"], found["experiments"]
    best = max(one["best_episode"] for one in earlier.values())
    assert earlier["paper_frame"]["mean"] < 500
    assert earlier["two_iterations_frame"]["mean"] + 75 > best
    assert all(len(earlier[f"no_bar_{variant}"]["runs"]) == 2 for variant in VARIANTS)
    yaw = {one: found["study3"][f"agent: {one}"]["z"]["yaw rate"]["values"] for one in VARIANTS}
    assert min(yaw.pop("input_output")) > 0.8 > 0.4 > max(map(max, yaw.values()))
    assert all(agents[variant]["mean"] > 905 for variant in VARIANTS)
    assert agents["frame"]["failed"] == 0 and agents["cropped_input"]["mean"] < 900


def test_lost_points_add_up():
    lost = measurements.lost_points(np.array([950.0, 700.0]), np.array([500, 1000]))
    assert lost == {"speed": 50, "waiting": 25, "tiles": 100}
