"""Checks of exercises: what was found, what was expected, and which mistake gives just that.

A check knows the common mistakes of its exercise. An answer that equals what one of them computes
gets that mistake's hint; any other wrong answer gets the difference. A notebook shows a wrong
answer as a short panel, without a traceback.
"""

import copy
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

import stad_lab

PACKAGES = Path(__file__).parents[1], Path(stad_lab.__file__).parent
OURS = (*map(str, PACKAGES), sys.prefix, sys.base_prefix)
BY_HAND = "work this value out by hand, and print what your function computes on the way to it"
BY_SAMPLE = "print one resample and its result, and how many there are"


class Panel:
    """An exception that IPython shows as a few lines in place of its traceback."""

    def panel(self) -> list[str]:
        """The lines of the panel, its title first."""
        raise NotImplementedError

    def _render_traceback_(self) -> list[str]:
        title, *lines = self.panel()
        return [f"\x1b[1m{title}\x1b[0m", *lines]


class WrongAnswer(Panel, AssertionError):
    """A wrong answer: what was asked, what is wrong, what to look at, and what was found."""

    def __init__(self, what: str, wrong: str, look: str = "", found: str = ""):
        text = ": ".join(filter(None, (what, wrong, look)))
        super().__init__(f"{text} ({found})" if found else text)
        self.parts = what, wrong, look, found

    def panel(self) -> list[str]:
        """The lines of the panel, its title first."""
        what, *parts = self.parts
        names = "What is wrong", "Look at", "Found"
        lines = [
            f"  {name + ':':15s}{part}" for name, part in zip(names, parts, strict=True) if part
        ]
        return [f"Not yet right: {what}", *lines]


class Unsolved(Panel, NotImplementedError):
    """An exercise without an answer."""

    def panel(self) -> list[str]:
        """The lines of the panel."""
        return ["Not done yet", f"  {self}"]


def ask(what: str, answer: Callable, *given: object) -> Any:
    """Call a student's function, and return its result.

    Raises WrongAnswer if the function stops with an error, returns None, or changes an array that
    it was given.
    """
    kept = copy.deepcopy(given)
    try:
        found = answer(*given)
    except Unsolved:
        raise
    except Exception as error:
        stops = f"your function stops with {type(error).__name__}: {error}"
        raise WrongAnswer(what, stops, place_of(error)) from None
    if found is None:
        raise WrongAnswer(what, "is None", "end your function with `return` and the result")
    for now, before in zip(given, kept, strict=True):
        if isinstance(now, np.ndarray | torch.Tensor) and not np.array_equal(
            to_numpy(now), to_numpy(before), equal_nan=True
        ):
            wrong = "your function changed an array that it was given"
            raise WrongAnswer(what, wrong, "begin with a copy: .copy() or .clone()")
    return found


def place_of(error: Exception) -> str:
    """The last line of the student's own code that an error passed through."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(OURS)]
    return f"line {own[-1].lineno} of its cell, {own[-1].line}" if own and own[-1].line else ""


def check(
    what: str,
    found: object,
    expected: object,
    mistakes: Mapping[str, object] | None = None,
    tolerance: float = 1e-4,
    look: str = BY_HAND,
) -> None:
    """Print that an answer is right, or raise WrongAnswer with a diagnosis.

    Args:
        what: name of the answer, as the student knows it, for example "differences(frames, 4)".
        found: the student's answer: a number, an array or a tensor.
        expected: the right answer, of the same kind (tensor or not; whole, real or bool).
        mistakes: hint -> what that mistake computes. A hint says what is wrong, then after a colon
            the remedy.
        tolerance: largest error, as a share of the largest finite number of `expected`.
        look: what to look at if no mistake gives the answer.
    """
    check_kind(what, found, expected)
    found, expected = to_numpy(found), to_numpy(expected)
    if not agree(found, expected, tolerance):
        difference = describe_difference(found, expected)
        for hint, wrong in (mistakes or {}).items():
            if agree(found, to_numpy(wrong), tolerance):
                cause, _, remedy = hint.partition(": ")
                raise WrongAnswer(what, cause, remedy, difference)
        same = found.shape == expected.shape
        raise WrongAnswer(what, difference, look if same else "print the shape of your result")
    if found.dtype.kind != expected.dtype.kind:
        wrong = f"right values, but dtype {found.dtype}"
        raise WrongAnswer(what, wrong, f"expected {expected.dtype}")
    print(f"{what}: right")


def check_interval(
    what: str, answer: Callable, given: tuple, right: tuple, bounds: dict, tolerance: float
) -> None:
    """Check an interval that a student's function computes by resampling."""
    mistakes = {hint: np.array(pair, float) for hint, pair in bounds.items()}
    found = ask(what, answer, *given)
    check(what, found, np.array(right, float), mistakes, tolerance, BY_SAMPLE)


def check_kind(what: str, found: object, expected: Any) -> None:
    """Raise WrongAnswer if an answer is no number, array or tensor where one is expected."""
    kind, wanted = type(found).__name__, type(expected).__name__
    is_tensor, wants_tensor = (isinstance(one, torch.Tensor) for one in (found, expected))
    if found is None:
        raise WrongAnswer(what, "is None", "end your function with `return` and the result")
    if is_tensor and not wants_tensor:
        remedy = "an array: use .numpy()" if np.ndim(expected) else "a number: use float(...)"
        raise WrongAnswer(what, "is a tensor", f"expected {remedy}")
    if isinstance(found, str | dict) or (wants_tensor and not is_tensor):
        raise WrongAnswer(what, f"is of type {kind}", f"expected {wanted}")
    if isinstance(found, list | tuple) and isinstance(expected, np.ndarray):
        raise WrongAnswer(what, f"is a {kind}", "expected an array; wrap it in np.array(...)")


def to_numpy(value: object) -> np.ndarray:
    """A number, list, array or tensor as an array, without gradients; WrongAnswer otherwise."""
    try:
        return value.detach().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    except ValueError as error:
        wrong = "your answer is no array"
        raise WrongAnswer(wrong, "its parts differ in length", found=str(error)) from error
    except (RuntimeError, TypeError) as error:  # for example a list of tensors with gradients
        raise WrongAnswer("your answer is no array", "and cannot become one", str(error)) from error


def agree(found: np.ndarray, other: np.ndarray, tolerance: float) -> bool:
    """Whether two arrays of numbers have one shape and the same values, up to the tolerance."""
    if found.shape != other.shape or found.dtype.kind not in "biuf":
        return False
    largest = float(np.abs(other[np.isfinite(other)], dtype=float).max(initial=0))
    error = tolerance * (largest or 1.0) + 1e-12  # 1 for an answer that is all zeros
    return np.allclose(found.astype(float), other.astype(float), 0, error, equal_nan=True)


def describe_difference(found: np.ndarray, expected: np.ndarray) -> str:
    """The first difference from what was expected: kind, shape, finiteness or a value."""
    if found.dtype.kind not in "biuf":
        return f"found dtype {found.dtype}, expected numbers"
    if found.shape != expected.shape:
        return f"found shape {found.shape}, expected {expected.shape}"
    strange, wanted = ~np.isfinite(found), ~np.isfinite(expected)
    if not np.array_equal(strange, wanted):
        elsewhere = ", elsewhere" if strange.sum() == wanted.sum() else ""
        count = f"expected {wanted.sum() or 'none'}{elsewhere}"
        return f"found {strange.sum()} numbers that are not finite (NaN or infinite), {count}"
    same = (found == expected) | np.isnan(found) & np.isnan(expected)
    with np.errstate(invalid="ignore"):  # infinite numbers are the same or not
        error = np.abs(found.astype(float) - expected.astype(float))
    error = np.where(wanted, np.where(same, 0.0, np.inf), error)
    place = tuple(int(i) for i in np.unravel_index(np.argmax(error), error.shape))
    where = f" at index {place}" if place else ""
    return f"found {found[place]:.6g}{where}, expected {expected[place]:.6g}"
