"""What a submission may use."""

import math
from dataclasses import asdict, dataclass

MOST = 1e6  # of any limit


@dataclass(frozen=True)
class Limits:
    """What a submission may use.

    Args:
        start: seconds to load, to begin episodes, and for its first action.
        step: seconds for each observation, on average over the cars of a batch.
        total: seconds for all that it is asked on all tracks; loading does not count.
        memory: gigabytes of its process.
    """

    start: float = 60.0
    step: float = 0.2
    total: float = 300.0
    memory: float = 2.0

    def __post_init__(self):
        for name, value in asdict(self).items():
            if not (math.isfinite(value) and 0 < value <= MOST):
                raise ValueError(f"limits.{name}={value:g}: expected more than 0, up to {MOST:g}")
