"""Ridge regression, for the controller of a second iteration and for the motion probe."""

import numpy as np


def fit_ridge(
    features: np.ndarray, targets: np.ndarray, penalty: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit targets = features @ weights + intercept, with a penalty on the squared weights.

    Args:
        features: (n, features).
        targets: (n, targets).
        penalty: times the sum of the squared weights, beside the sum of squared errors; one, or one
            for each target (targets,).

    Returns:
        Weights float64 (features, targets) and intercept (targets,).
    """
    middle, target = features.mean(axis=0, dtype=np.float64), targets.mean(axis=0, dtype=np.float64)
    centred = features - middle
    square, product = centred.T @ centred, centred.T @ (targets - target)
    penalties = np.broadcast_to(penalty, product.shape[1])
    weights = np.empty_like(product)
    for one in np.unique(penalties):
        columns = penalties == one
        ridge = square + one * np.eye(len(square))
        weights[:, columns] = np.linalg.solve(ridge, product[:, columns])
    return weights, target - middle @ weights
