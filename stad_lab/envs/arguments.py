"""Checks of arguments: a wrong one ends in one line with its name and what was expected.

What compiled code gets is checked here first, because it would write beyond its arrays.
"""

import math
from collections.abc import Iterable
from typing import Any, TypeGuard

import numpy as np


def shown(value: Any) -> str:
    """A value as a message shows it: at most 60 characters in one line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def is_whole(value: Any) -> TypeGuard[int]:
    """Whether a value is a whole number; True and False are none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def whole_number(name: str, value: Any, least: int = 0, most: int | None = None) -> int:
    """The value as an int. ValueError unless it is a whole number from `least` to `most`."""
    if not is_whole(value) or value < least or (most is not None and value > most):
        end = "on" if most is None else f"to {most:,}"
        raise ValueError(f"{name}={shown(value)}: expected a whole number from {least} {end}")
    return int(value)


def finite_number(name: str, value: Any) -> float:
    """The value as a float. ValueError unless it is a number between -1e300 and 1e300."""
    number = isinstance(value, int | float | np.integer | np.floating)
    if isinstance(value, bool) or not number or not abs(value) < 1e300 or not math.isfinite(value):
        raise ValueError(f"{name}={shown(value)}: expected a finite number")
    return float(value)


def numbers(name: str, value: Any, expected: str) -> np.ndarray:
    """The value as an array of numbers or bools. ValueError for anything else."""
    try:
        found = np.asarray(value)
    except (ValueError, TypeError, RuntimeError):  # its parts differ in length, for example
        found = np.empty(0, object)
    if found.dtype.kind not in "biuf":
        raise ValueError(f"{name}={shown(value)}: expected {expected}")
    return found


def finite_array(name: str, value: Any, shape: tuple[int, ...], meaning: str) -> np.ndarray:
    """An array or tensor as float32. ValueError for another shape, or numbers that are not finite.

    `meaning` says in the message what the numbers are.
    """
    found = numbers(name, value, f"{shape} finite numbers, {meaning}").astype(np.float32)
    finite = np.isfinite(found)
    if found.shape != shape or not finite.all():
        raise ValueError(
            f"{name} of shape {found.shape}, {finite.sum()} of them finite: expected {shape}"
            f" finite numbers, {meaning}"
        )
    return found


def choice(name: str, value: Any, choices: Iterable[str | None]) -> Any:
    """The value itself. ValueError unless it is one of the choices."""
    known = list(choices)
    if not isinstance(value, str | None) or value not in known:
        raise ValueError(f"{name}={shown(value)}: choose one of {', '.join(map(str, known))}")
    return value


def check_options(options: Any) -> dict:
    """The options of a `reset`; {} for None. ValueError unless they are a dict."""
    if options is not None and not isinstance(options, dict):
        raise ValueError(f"options={shown(options)}: expected a dict or None")
    return options or {}


def car_numbers(which: Any, count: int) -> np.ndarray:
    """Numbers of cars, or a mask of them, as int64 (n,); all for None. ValueError for others."""
    expected = f"numbers of cars, each once, from 0 to {count - 1}"
    if which is None:
        return np.arange(count)
    found = numbers("which", which, expected)
    if found.dtype == bool and found.shape == (count,):  # a mask
        return np.flatnonzero(found)
    fits = found.ndim == 1 and (found.dtype.kind in "iu" or not len(found))
    values = found.tolist() if fits else []
    if not fits or not set(range(count)).issuperset(values) or len(set(values)) < len(values):
        raise ValueError(f"which={shown(which)}: expected {expected}")
    return found.astype(np.int64)
