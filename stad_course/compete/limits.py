"""What a submission may use."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What a submission may use.

    Args:
        start: seconds to load, and for its first action.
        step: seconds for each observation, on average over the cars of a batch.
        total: seconds for all its actions on all tracks.
        memory: gigabytes of its process.
    """

    start: float = 60.0
    step: float = 0.2
    total: float = 300.0
    memory: float = 2.0
