"""Instant checks of exercises: they say what was found, what was expected, and which mistake gives just that.

A check knows the common mistakes of its exercise, and what each of them computes. An answer that equals one of these
earns that mistake's hint; any other wrong answer earns the plain difference.
"""

import numpy as np
import torch


def check(
    what: str,
    found: object,
    expected: object,
    mistakes: dict[str, object] | None = None,
    tolerance: float = 1e-4,
) -> None:
    """Raise AssertionError with a diagnosis unless an answer is right; print that it is, if so.

    Args:
        what: name of the answer, as the student knows it, for example "differences(film, 4)".
        found: the student's answer: a number, an array or a tensor.
        expected: the right answer. The student's must be of the same kind (tensor or not; whole, real or bool).
        mistakes: hint -> what that mistake computes. A hint says what was done and what to do instead.
        tolerance: largest error that is let pass, as a share of the largest number of `expected` (of 1, if that is
            larger). A mistake is recognised within the same.
    """
    if found is None:
        raise AssertionError(f"{what} is None: end your function with `return` and the result")
    if isinstance(found, torch.Tensor) and not isinstance(expected, torch.Tensor):
        remedy = (
            "an array, which .numpy() makes of it"
            if np.ndim(expected)
            else "a number, which float(...) makes of it"
        )
        raise AssertionError(f"{what} is a tensor: expected {remedy}")
    if isinstance(found, str | dict) or (
        isinstance(expected, torch.Tensor) and not isinstance(found, torch.Tensor)
    ):
        raise AssertionError(
            f"{what} is of type {type(found).__name__}: expected {type(expected).__name__}"
        )
    if isinstance(found, list | tuple) and isinstance(expected, np.ndarray):
        raise AssertionError(
            f"{what} is a {type(found).__name__}: expected an array; wrap it in np.array(...)"
        )
    found, expected = to_numpy(found), to_numpy(expected)
    if not agree(found, expected, tolerance):
        for hint, wrong in (mistakes or {}).items():
            if agree(found, to_numpy(wrong), tolerance):
                raise AssertionError(f"{what}: {hint} ({describe_difference(found, expected)})")
        raise AssertionError(f"{what}: {describe_difference(found, expected)}")
    if found.dtype.kind != expected.dtype.kind:
        raise AssertionError(
            f"{what} has the right values, but dtype {found.dtype}: expected {expected.dtype}"
        )
    print(f"{what}: right")


def to_numpy(value: object) -> np.ndarray:
    """A number, list, array or tensor as an array; a tensor's gradient is left behind. AssertionError if it is none."""
    try:
        return value.detach().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    except ValueError as error:
        raise AssertionError(
            f"this is no array, since its parts differ in length ({error})"
        ) from error
    except (
        RuntimeError,
        TypeError,
    ) as error:  # a list of tensors that keep their gradients, for example
        raise AssertionError(f"this is no array, and cannot be made one: {error}") from error


def agree(found: np.ndarray, other: np.ndarray, tolerance: float) -> bool:
    """Whether two arrays of numbers have one shape and the same values, up to the tolerance of `check`."""
    if found.shape != other.shape or found.dtype.kind not in "biuf":
        return False
    scale = max(1.0, float(np.abs(other[np.isfinite(other)], dtype=float).max(initial=0)))
    return np.allclose(
        found.astype(float), other.astype(float), rtol=0, atol=tolerance * scale, equal_nan=True
    )


def describe_difference(found: np.ndarray, expected: np.ndarray) -> str:
    """The first thing in which an answer differs from what was expected: kind, shape, finiteness or a value."""
    if found.dtype.kind not in "biuf":
        return f"found dtype {found.dtype}, expected numbers"
    if found.shape != expected.shape:
        return f"found shape {found.shape}, expected {expected.shape}"
    strange, wanted = ~np.isfinite(found), ~np.isfinite(expected)
    if not np.array_equal(strange, wanted):
        elsewhere = ", elsewhere" if strange.sum() == wanted.sum() else ""
        return (
            f"found {strange.sum()} numbers that are not finite (NaN or infinite), expected {wanted.sum() or 'none'}"
            f"{elsewhere}"
        )
    same = (found == expected) | np.isnan(found) & np.isnan(expected)
    with np.errstate(invalid="ignore"):  # of infinite numbers, which are the same or not
        error = np.where(
            wanted,
            np.where(same, 0.0, np.inf),
            np.abs(found.astype(float) - expected.astype(float)),
        )
    place = tuple(int(i) for i in np.unravel_index(np.argmax(error), error.shape))
    where = f" at index {place}" if place else ""
    return f"found {found[place]:.6g}{where}, expected {expected[place]:.6g}"
