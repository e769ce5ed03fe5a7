"""Who won, and who is not significantly behind."""

import numpy as np
import pandas as pd

from stad_lab.evaluation.statistics import describe_tail, holm, paired_p, summarise


def rank(results: list[dict]) -> pd.DataFrame:
    """One row for each submission, best mean first; submissions with equal returns share a place.

    Column `tied` says who is not significantly behind the first: the paired t-test over tracks,
    after Holm for the number of submissions, has p >= 0.05.
    """
    rows = []
    for result in results:
        returns = np.array(result["returns"])
        rows.append({**result, **summarise(returns), **describe_tail(returns)})
    order = ["mean", "minimum", "name"]
    table = pd.DataFrame(rows).sort_values(order, ascending=[False, False, True])
    table["place"] = table["mean"].rank(method="min", ascending=False).astype(int)
    best = np.array(table["returns"].iloc[0])
    differences = [best - np.array(own) for own in table["returns"].iloc[1:]]
    p_values = [p_of(one) for one in differences]
    table["tied"] = [True, *(p >= 0.05 for p in holm(p_values))]
    return table.reset_index(drop=True)


def p_of(differences: np.ndarray) -> float:
    """P-value of paired differences; 1 or 0 if they are all equal, where there is no t."""
    if np.ptp(differences) == 0:
        return float(differences[0] == 0)
    return paired_p(differences)
