"""The checks of exercises: right answers pass, wrong and nearly right ones get a diagnosis."""

import numpy as np
import pytest
import torch
from IPython.core.interactiveshell import InteractiveShell
from traitlets.config import Config

from stad_course.checks.answers import WrongAnswer, ask, check

RIGHT = np.array([0.5, -2.0, 3.0], np.float32)


def test_a_right_answer_passes_and_says_so(capsys):
    check("f(x)", RIGHT.copy(), RIGHT, {"never": RIGHT + 1})
    check("f(x)", 7, np.int64(7))
    check("f(x)", torch.ones(2, requires_grad=True), torch.ones(2))
    assert capsys.readouterr().out == "f(x): right\n" * 3


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (None, "f.x.: is None: end your function with `return`"),
        ([0.5, -2.0, 3.0], "is a list: expected an array"),
        (torch.from_numpy(RIGHT), "is a tensor: expected an array: use .numpy"),
        ("0.5", "is of type str"),
        (RIGHT[:2], r"found shape \(2,\), expected \(3,\)"),
        (RIGHT[None], r"found shape \(1, 3\), expected \(3,\)"),
        (np.array([0.5, np.nan, 3.0]), "found 1 numbers that are not finite"),
        (RIGHT + 0.001 * np.eye(3)[1], r"found -1.999 at index \(1,\), expected -2"),
        (np.array(["a", "b", "c"]), "found dtype <U1, expected numbers"),
        (
            -RIGHT,
            r"f.x.: the sign .*found -3 at index \(2,\), expected 3|f.x.: the sign .*found 2 at",
        ),
        (np.full(2, np.nan), "two NaN"),
    ],
)
def test_a_wrong_answer_gets_a_diagnosis(found, message):
    with pytest.raises(AssertionError, match=message):
        check(
            "f(x)",
            found,
            RIGHT,
            {"the sign is turned round": -RIGHT, "two NaN": np.full(2, np.nan)},
        )


def test_a_notebook_shows_a_wrong_answer_as_a_panel_without_a_traceback(capsys):
    shell = InteractiveShell(config=Config({"HistoryManager": {"enabled": False}}))
    shell.run_cell("def half(x):\n    return x.size / two")
    shell.user_ns |= {"ask": ask, "check": check, "right": RIGHT}
    shell.run_cell("check('f(x)', -right, right, {'the sign is turned round: add': -right})")
    shell.run_cell("ask('half(x)', half, right)")
    shown = capsys.readouterr().out
    assert "Traceback" not in shown and "stad_course/checks" not in shown and "---" not in shown
    lines = [line.strip() for line in shown.splitlines()]
    assert len(lines) == 7 and lines[1] == "What is wrong: the sign is turned round"
    assert lines[2].startswith("Look at:") and lines[2].endswith("add")
    assert "name 'two' is not defined" in lines[5] and lines[6].endswith("return x.size / two")


def test_a_function_that_changes_what_it_is_given_is_told_to_copy():
    def spoil(x):
        x += 1
        return x

    for given in (RIGHT.copy(), torch.ones(2)):
        with pytest.raises(WrongAnswer, match=r"changed an array that it was given: .*copy"):
            ask("spoil(x)", spoil, given)


@pytest.mark.parametrize(
    ("found", "expected", "message"),
    [
        ([1.0, 2.0], [1.0, np.nan], "found 0 numbers that are not finite .*expected 1: "),
        (
            [np.nan, 2.0],
            [1.0, np.nan],
            "found 1 numbers that are not finite .*expected 1, elsewhere",
        ),
        ([np.inf, np.inf], [np.nan, np.nan], r"found inf at index \(0,\), expected nan"),
        ([1.0, np.inf], [1.0, np.nan], r"found inf at index \(1,\), expected nan"),
        ([1.0, -np.inf], [1.0, np.inf], r"found -inf at index \(1,\), expected inf"),
        ([5.0, np.nan], [1.0, np.nan], r"found 5 at index \(0,\), expected 1"),
    ],
)
def test_answers_that_are_not_finite_get_a_diagnosis(found, expected, message):
    with pytest.raises(AssertionError, match=message):
        check("f(x)", np.array(found), np.array(expected))


def test_a_list_of_tensors_with_gradients_is_refused():
    with pytest.raises(
        AssertionError, match=r"is no array: and cannot become one: .*requires grad"
    ):
        check("the answer", [torch.ones(2, requires_grad=True)], [[1.0, 1.0]])


def test_a_list_of_unequal_parts_is_refused():
    with pytest.raises(AssertionError, match="parts differ in length"):
        check("f(x)", [[1, 2], [3]], [[1, 2], [3, 4]])


def test_right_values_of_another_kind_are_refused():
    with pytest.raises(AssertionError, match="right values, but dtype float64: expected int64"):
        check("f(x)", np.array([1.0, 2.0]), np.array([1, 2]))


def test_the_tolerance_is_a_share_of_the_largest_number():
    check("f(x)", np.array([0.0, 1000.09]), np.array([0.0, 1000.0]))
    with pytest.raises(AssertionError, match=r"found 1000\.2"):
        check("f(x)", np.array([0.0, 1000.2]), np.array([0.0, 1000.0]))


def test_small_answers_are_not_taken_for_zero():
    small = np.array([2e-6, -5e-6])
    check("f(x)", small * (1 + 1e-5), small)
    check("f(x)", np.zeros(2), np.zeros(2))
    for wrong in (np.zeros(2), small * 1.001, small[::-1]):
        with pytest.raises(AssertionError, match="found"):
            check("f(x)", wrong, small)
    with pytest.raises(AssertionError, match=r"found 0, expected 3e-05"):
        check("f(x)", 0.0, 3e-5)
    with pytest.raises(AssertionError, match="half"):
        check("f(x)", small / 2, small, {"half": small / 2})
