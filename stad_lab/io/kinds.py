"""What each kind of file holds: a file with a right checksum may still be another program's.

A shape is a type, a tuple of shapes of which one must fit, a list of the shape that every element
has, or a dict of the entries that must be there. An entry with "?" may be missing.
"""

from typing import Any

NUMBERS, SETTINGS = [(int, float)], dict
PROVENANCE = {"python?": str, "processor?": str}
TRACK = {"track": int, "return": (int, float), "frames": int}
VALIDATION = {
    "mean": (int, float),
    "returns": NUMBERS,
    "frames": int,
    "controller_checksum": int,
}
GENERATION = {
    "generation": int,
    "tracks": [int],
    "returns": [NUMBERS],
    "frames": int,
    "mean_checksum": int,
    "validation?": VALIDATION,
}
HISTORY = [{"step": int, "train": dict, "heldout": dict}]
EPISODE = {"index": int, "track": int, "frames": int, "frames_sha256": str, "actions_sha256": str}

SHAPES: dict[str, Any] = {
    "dataset": {
        "episodes": [EPISODE],
        "made_with": {"data": {"episodes": int, "agent_episodes?": int}},
    },
    "evolution": {
        "variant": str,
        "seed": int,
        "evolution": {"generations": int},
        "random": {"entropy": (int, [int]), "spawn_key": [int]},
        "best": (type(None), {"generation": int, "validation": (int, float)}),
        "generations": [GENERATION],
    },
    "record": {
        "variant": str,
        "config?": SETTINGS,
        "made_with": PROVENANCE,
        "continued_with?": [PROVENANCE],
        "seconds?": dict,
        "budget?": dict,
        "earlier?": {"config": SETTINGS},
    },
    "evaluation": {
        "variant": str,
        "renderer": str,
        "controller?": str,
        "episodes": [TRACK],
        "made_with?": PROVENANCE,
    },
    "unfinished evaluation": {
        "asked": dict,
        "driven": dict,
        "seconds": (int, float),
    },
    "vae": {"variant": str, "crop_bar": bool, "weights": str, "dataset?": (str, type(None))},
    "mdn_rnn": {"latent_size": int, "vae": (str, type(None)), "weights": str},
    "controller": {"variant": str, "generation?": int},
    "training": {"history": HISTORY, "made_with": SETTINGS},
}


def find_fault(value: Any, shape: Any, name: str = "") -> str | None:
    """What in `value` does not fit the shape, in words; None if all does."""
    if isinstance(shape, tuple):
        faults = [find_fault(value, one, name) for one in shape]
        return None if None in faults else faults[-1]
    if isinstance(shape, type):
        fits = isinstance(value, shape) and (shape is bool or not isinstance(value, bool))
        return None if fits else f"{name or 'it'} is not of type {shape.__name__}"
    if type(value) is not type(shape):
        return f"{name or 'it'} is not of type {type(shape).__name__}"
    if isinstance(shape, list):
        parts = [(one, shape[0], f"{name}[{place}]") for place, one in enumerate(value)]
    else:
        if missing := [key for key in shape if key[-1] != "?" and key not in value]:
            return f"it lacks {name}{'.' * bool(name)}{missing[0]}"
        known = {key.removesuffix("?"): one for key, one in shape.items()}
        parts = [
            (value[key], one, f"{name}{'.' * bool(name)}{key}")
            for key, one in known.items()
            if key in value
        ]
    return next(filter(None, (find_fault(*part) for part in parts)), None)
