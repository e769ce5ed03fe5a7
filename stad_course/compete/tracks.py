"""Hidden tracks by commit and reveal: their hash is published before, their seeds afterwards."""

import secrets
from pathlib import Path

from stad_lab.io.files import checksum_of_json, load_json, save_json

KIND = "hidden tracks"
COUNT = 50
SEEDS = range(5_000_000, 2**31)  # beyond all tracks that stad_lab trains and tests with


def hide_tracks(file: Path, count: int | None = None) -> str:
    """Draw tracks and write them to a file, unless it exists; returns the hash to publish.

    Args:
        count: how many; COUNT if not given. ValueError if a file that exists has another number.
    """
    if count is not None and count < 2:
        raise ValueError(f"tracks={count}: expected at least 2")
    if file.suffix != ".json" or file.is_dir():
        raise ValueError(f"{file}: expected the name of a file of hidden tracks, ending in .json")
    if file.exists():
        tracks, commitment = load_tracks(file)
        if count not in (None, len(tracks)):
            raise ValueError(f"{file} has {len(tracks)} tracks, not {count}: choose another file")
        return commitment
    tracks = [SEEDS.start + secrets.randbelow(len(SEEDS)) for _ in range(count or COUNT)]
    # The salt keeps anyone from trying all seeds until a hash fits.
    save_json(file, {"kind": KIND, "tracks": tracks, "salt": secrets.token_hex(32)})
    return load_tracks(file)[1]


def load_tracks(file: Path) -> tuple[list[int], str]:
    """The seeds of a file of hidden tracks, and its hash."""
    if file.suffix != ".json" or file.is_dir():
        raise ValueError(f"{file} is no file of hidden tracks: they end in .json")
    found = load_json(file, f"make it with `python -m stad_course commit {file}`", kind=KIND)
    return found["tracks"], checksum_of_json({name: found[name] for name in ("salt", "tracks")})
