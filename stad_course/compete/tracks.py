"""Hidden tracks by commit and reveal: their hash is published before, their seeds afterwards."""

import secrets
from pathlib import Path

from stad_lab.io.files import checksum_of_json, load_json, save_json

KIND = "hidden tracks"
SEEDS = range(5_000_000, 2**31)  # beyond all tracks that stad_lab trains and tests with


def hide_tracks(file: Path, count: int) -> str:
    """Draw tracks and write them to a file, unless it exists; returns the hash to publish."""
    if count < 2:
        raise ValueError(f"tracks={count}: expected at least 2")
    if not file.exists():
        tracks = [SEEDS.start + secrets.randbelow(len(SEEDS)) for _ in range(count)]
        # The salt keeps anyone from trying all seeds until a hash fits.
        save_json(file, {"kind": KIND, "tracks": tracks, "salt": secrets.token_hex(32)})
    return load_tracks(file)[1]


def load_tracks(file: Path) -> tuple[list[int], str]:
    """The seeds of a file of hidden tracks, and its hash."""
    found = load_json(file, f"make it with `python -m stad_course commit {file}`", kind=KIND)
    return found["tracks"], checksum_of_json({name: found[name] for name in ("salt", "tracks")})
