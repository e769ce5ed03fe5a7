"""What the folded cells of the lessons reveal is still what the shipped networks do."""

import json
from pathlib import Path

import numpy as np

from stad_lab.evaluation.metrics import region_masks

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


def names_after(lesson: str, *cells: str) -> dict:
    """The names that these cells of a lesson bind, such as 02-04."""
    (file,) = NOTEBOOKS.glob(f"{lesson}_*.ipynb")
    read = json.loads(file.read_text(encoding="utf-8"))["cells"]
    source, names = {cell["id"]: "".join(cell["source"]) for cell in read}, {}
    for cell in cells:
        exec(source[f"{lesson}-{cell}"], names)
    return names


def test_32_numbers_keep_the_road_and_the_car_but_not_the_squares():
    names = names_after("02", "01", "02", "04", "14")
    frames, share = names["frames"], names["share"]
    again = names["reconstruct_frames"](names["vaes"]["frame"], frames)
    first, second = (region_masks(part)["road"] for part in (frames, again))
    assert (first & second).sum() > 0.8 * (first | second).sum()
    kept = {}
    for region, color in (("car", 0), ("grass", 1)):
        there = region_masks(frames)[region]
        kept[region] = np.corrcoef(frames[there][:, color], again[there][:, color])[0, 1]
    assert kept["car"] > 0.8 > 0.7 > kept["grass"]
    assert 0.05 < share["output"] / share["input_output"] < 0.8


def test_without_memory_m_loses_most_and_a_dream_turns_with_the_wheel():
    names = names_after("03", "02", "03", "57", "29", "44", "45")
    rows = names["rows"]
    worse = {name: rows[name]["NLL"][0] for name in ("no memory", "no actions", "one Gaussian")}
    assert max(worse, key=worse.get) == "no memory"
    last = [region_masks(film[-1:])["road"][0, :45] for film in names["turns"].values()]
    left, _, right = (np.nonzero(road)[1].mean() for road in last)  # columns of the road
    assert left > right
