"""Checks of the exercises: what was found, what was expected, and which mistake gives just that.

A check knows the common mistakes of its exercise. An answer that equals what one of them computes
gets that mistake's hint; any other wrong answer gets the difference.
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
    """Print that an answer is right, or raise AssertionError with a diagnosis.

    Args:
        what: name of the answer, as the student knows it, for example "differences(frames, 4)".
        found: the student's answer: a number, an array or a tensor.
        expected: the right answer, of the same kind (tensor or not; whole, real or bool).
        mistakes: hint -> what that mistake computes. A hint names the mistake and the remedy.
        tolerance: largest error, as a share of the largest finite number of `expected`.
    """
    check_kind(what, found, expected)
    found, expected = to_numpy(found), to_numpy(expected)
    if not agree(found, expected, tolerance):
        difference = describe_difference(found, expected)
        for hint, wrong in (mistakes or {}).items():
            if agree(found, to_numpy(wrong), tolerance):
                raise AssertionError(f"{what}: {hint} ({difference})")
        raise AssertionError(f"{what}: {difference}")
    if found.dtype.kind != expected.dtype.kind:
        raise AssertionError(
            f"{what} has the right values, but dtype {found.dtype}: expected {expected.dtype}"
        )
    print(f"{what}: right")


def check_kind(what: str, found: object, expected: object) -> None:
    """Raise AssertionError if an answer is no number, array or tensor where one is expected."""
    kind, wanted = type(found).__name__, type(expected).__name__
    is_tensor, wants_tensor = (isinstance(one, torch.Tensor) for one in (found, expected))
    if found is None:
        raise AssertionError(f"{what} is None: end your function with `return` and the result")
    if is_tensor and not wants_tensor:
        remedy = "an array: use .numpy()" if np.ndim(expected) else "a number: use float(...)"
        raise AssertionError(f"{what} is a tensor: expected {remedy}")
    if isinstance(found, str | dict) or (wants_tensor and not is_tensor):
        raise AssertionError(f"{what} is of type {kind}: expected {wanted}")
    if isinstance(found, list | tuple) and isinstance(expected, np.ndarray):
        raise AssertionError(f"{what} is a {kind}: expected an array; wrap it in np.array(...)")


def to_numpy(value: object) -> np.ndarray:
    """A number, list, array or tensor as an array, without gradients; AssertionError otherwise."""
    try:
        return value.detach().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    except ValueError as error:
        raise AssertionError(f"this is no array: its parts differ in length ({error})") from error
    except (RuntimeError, TypeError) as error:  # for example a list of tensors with gradients
        raise AssertionError(f"this is no array, and cannot become one: {error}") from error


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
