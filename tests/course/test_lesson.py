"""The lesson tools: predictions, questions with instant answers, and drawings that can be seen."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from stad_course.lesson import predict, quiz

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
DRAWINGS = sorted((NOTEBOOKS / "pictures" / "schematics").glob("*.svg"))
SVG = "{http://www.w3.org/2000/svg}"


def shown(prediction):
    """What `reveal` shows."""
    return prediction._result().data


def test_a_prediction_is_kept_and_shown_beside_the_result(capsys):
    guess = predict("What will it do?", ["spin", "stop"])
    guess.control.value = "stop"
    guess.reveal("spin", "The tyres slip.")
    assert all(text in shown(guess) for text in ("stop", "Result: spin.", "The tyres slip."))
    guess.control.value = "spin"  # after the result: the page follows
    assert "spin. &#10003;" in shown(guess)


def test_a_result_stays_folded_for_who_has_made_no_prediction(capsys):
    for guess, result in (
        (predict("What?", ["spin", "stop"]), "stop"),
        (predict("How far?", (0, 90), "metres"), 12.34567),
    ):
        guess.reveal(result)
        assert guess.answer is None and "<details>" in shown(guess)
    assert "12.35 metres" in shown(guess)
    guess.control.value = 20
    assert "20 metres" in shown(guess)


@pytest.mark.parametrize(("limits", "result"), [((-0.25, 1.0), 0.63), ((1.0, 10.0), 7.6)])
def test_a_slider_reaches_the_result_and_is_then_right(limits, result):
    guess = predict("How much?", limits)
    steps = round((result - guess.control.min) / guess.control.step)
    guess.control.value = guess.control.min + steps * guess.control.step
    guess.reveal(result)
    assert f"{result}. &#10003;" in shown(guess)


def test_a_page_without_a_kernel_shows_the_question_and_its_choices():
    text = predict("What will it do?", ["spin", "stop"])._repr_mimebundle_()["text/html"]
    assert "What will it do?" in text and "spin / stop" in text


def test_a_result_that_is_no_option_and_a_right_answer_that_is_none_are_refused():
    with pytest.raises(ValueError, match="'fly': expected one of spin, stop"):
        predict("What?", ["spin", "stop"]).reveal("fly")
    with pytest.raises(ValueError, match="question 1: no answer has the number 2"):
        quiz(("What?", [("spin", "It slips."), ("stop", "It rolls.")], 2))


def test_a_quiz_has_one_right_answer_for_each_question_and_a_reason_for_every_answer():
    question = "What?", [("spin", "It slips."), ("stop", "It < rolls.")], 1
    page = quiz(question, question, question).data
    assert page.count("<summary>") == 6 and page.count("Right.") == 3
    assert page.count("It &lt; rolls.") == 3


@pytest.mark.parametrize("drawing", DRAWINGS, ids=lambda drawing: drawing.stem)
def test_a_drawing_is_readable_in_every_theme_and_loads_nothing(drawing):
    root = ElementTree.parse(drawing).getroot()
    first = next(one for one in root if one.tag not in {f"{SVG}title", f"{SVG}style", f"{SVG}defs"})
    assert root.get("viewBox") and root.find(f"{SVG}title").text
    assert first.tag == f"{SVG}rect" and first.get("fill")  # a background of its own
    text = drawing.read_text(encoding="utf-8")
    assert not re.search(r"<script|<image|href=|url\(h|@import", text)
    sizes = [float(size) for size in re.findall(r'font-size[:=]\s*"?([\d.]+)', text)]
    assert sizes and min(sizes) >= 13 * float(root.get("viewBox").split()[2]) / 760


def test_every_drawing_is_shown_with_an_alternative_text():
    pages = [*NOTEBOOKS.glob("*.ipynb"), NOTEBOOKS.parent / "README.md"]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    shown = {name for alt, name in re.findall(r"!\[([^\]]+)\]\([^)]*schematics/(\w+)\.svg\)", text)}
    assert {drawing.stem for drawing in DRAWINGS} <= shown
