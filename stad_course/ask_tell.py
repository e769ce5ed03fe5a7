"""An evolution strategy in two functions, `ask` and `tell`, and a check of a reader's own."""

from collections.abc import Callable

import numpy as np

Ask = Callable[[np.ndarray, float, int, np.random.Generator], np.ndarray]
Tell = Callable[[np.ndarray, np.ndarray], np.ndarray]


def ask(mean: np.ndarray, sigma: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Candidates around a mean (numbers,), with standard deviation sigma: (count, numbers)."""
    return mean + sigma * rng.standard_normal((count, len(mean)))


def tell(candidates: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """The next mean (numbers,): that of the quarter of the candidates with the highest returns."""
    best = np.argsort(-returns)[: len(returns) // 4]
    return candidates[best].mean(axis=0)


def yours_or_ours(their_ask: Ask, their_tell: Tell) -> tuple[Ask, Tell]:
    """A reader's functions if they are right, else ours; prints which, and what is wrong."""
    problem = problem_of_ask(their_ask) or problem_of_tell(their_tell)
    if problem:
        print(f"{problem}. Until then the cells below run with our ask and tell.")
        return ask, tell
    print("Your ask and tell are right: the cells below run with them.")
    return their_ask, their_tell


def run(own: Callable, *arguments: object, shape: tuple) -> tuple[np.ndarray, str]:
    """The float64 result of a reader's function, and what is wrong in type or shape, or ""."""
    nothing = np.empty(0)
    try:
        found = own(*arguments)
    except Exception as error:
        return nothing, f"ends in an error ({type(error).__name__}: {error})"
    if found is None or found is ...:
        return nothing, "is not written yet"
    if not isinstance(found, np.ndarray):
        return nothing, f"returns a {type(found).__name__}"
    if found.shape != shape:
        return nothing, f"returns an array of shape {found.shape}, here {shape} is right"
    return found.astype(float), ""


def problem_of_ask(own: Ask) -> str:
    """What is wrong with a reader's `ask`, "" if nothing."""
    mean, count = np.array([5.0, -5.0, 0.0]), 4000
    found, problem = run(own, mean, 0.5, count, np.random.default_rng(1), shape=(count, 3))
    if problem:
        return f"ask {problem}: expected an array (count, len(mean))"
    if not np.isfinite(found).all():
        return "ask returns numbers that are not finite: add sigma times the random numbers"
    if np.abs(found.mean(axis=0) - mean).max() > 0.1:
        return "ask scatters around another point: add the mean"
    if np.abs(found.std(axis=0) - 0.5).max() > 0.1:
        return "ask scatters too far or not far enough: multiply the random numbers by sigma"
    if np.abs(np.corrcoef(found.T) - np.eye(3)).max() > 0.1:
        return "ask moves all numbers of a candidate together: draw one for each"
    return ""


def problem_of_tell(own: Tell) -> str:
    """What is wrong with a reader's `tell`, "" if nothing."""
    rng = np.random.default_rng(2)
    candidates, returns = rng.standard_normal((12, 3)), rng.permutation(12.0 * np.arange(12))
    found, problem = run(own, candidates.copy(), returns.copy(), shape=(3,))
    if problem:
        return f"tell {problem}: expected an array (numbers,)"
    mistakes = {
        "tell averages all candidates: keep the best quarter": candidates.mean(axis=0),
        "tell averages the worst: a return is a score, high is good": tell(candidates, -returns),
        "tell keeps one candidate: average the best quarter": candidates[returns.argmax()],
        "tell averages the first ones: sort them by their returns": candidates[:3].mean(axis=0),
    }
    for problem, wrong in mistakes.items():
        if np.allclose(found, wrong):
            return problem
    right = np.allclose(found, tell(candidates, returns))
    quarter = len(returns) // 4
    problem = f"tell must average the best quarter, here {quarter} of {len(returns)}"
    return "" if right else problem
