"""Record what the live pages show: `python docs/live/record.py`.

It writes a drive of the shipped agent `input_output` as one lossless picture of all frames
(data/drive.webp) with its actions (data/drive.json), and what each latent of the four shipped V
encodes (data/latents.json). The tracks are from the range "inspect", which nothing is trained on.
"""

import base64
import io
import json
from pathlib import Path

import numpy as np
from PIL import Image

from stad_lab.agent import load_agent
from stad_lab.config import VARIANTS, track_seeds
from stad_lab.evaluation.trajectories import (
    MOTION,
    Trajectory,
    encode_trajectory,
    record_trajectory,
    road_in_sight,
)

DATA = Path(__file__).parent / "data"
AGENT, SEED, FRAMES = "input_output", 41, 480
COLUMNS = 20  # frames in a row of the picture
OTHERS, SKIP = 5, 60  # further trajectories for the latents; first frames, which zoom in


def sheet(frames: np.ndarray) -> bytes:
    """Frames uint8 (T, 64, 64, 3) side by side in rows of COLUMNS, as lossless WebP."""
    rows = np.concatenate(frames.reshape(-1, COLUMNS, *frames.shape[1:]), axis=1)
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(rows, axis=1)).save(
        buffer, "webp", lossless=True, quality=100, method=6
    )
    return buffer.getvalue()


def describe_latents(variant: str, trajectories: list[Trajectory]) -> list[dict]:
    """For each latent of a shipped V: its mean KL in nats, its mean, and what it correlates with.

    `quantity` is the one of MOTION with the largest absolute correlation r.
    """
    model, mu, kl, motion = load_agent(variant).world_model, [], [], []
    for one in trajectories:
        mean, logvar = encode_trajectory(model.vae, one, model.stride, model.crop_bar)
        seen = np.arange(len(one)) >= SKIP
        kl.append(0.5 * (mean**2 + np.exp(logvar) - 1 - logvar)[seen])
        seen &= road_in_sight(one.motion)
        mu.append(mean[seen])
        motion.append(one.motion[seen])
    mu, kl, motion = map(np.concatenate, (mu, kl, motion))
    r = np.corrcoef(mu.T, motion.T)[: mu.shape[1], mu.shape[1] :]
    best = np.abs(r).argmax(axis=1)
    return [
        {
            "kl": round(float(kl[:, i].mean()), 3),
            "mean": round(float(mu[:, i].mean()), 3),
            "quantity": list(MOTION)[best[i]],
            "r": round(float(r[i, best[i]]), 2),
        }
        for i in range(mu.shape[1])
    ]


def main() -> None:
    """Record the drive and describe the latents."""
    DATA.mkdir(exist_ok=True)
    agent = load_agent(AGENT)
    track, *others = track_seeds("inspect", 1 + OTHERS, SEED)
    drive = record_trajectory(agent, track, FRAMES)
    (DATA / "drive.webp").write_bytes(sheet(drive.frames(crop_bar=False)))
    facts = {"agent": AGENT, "track": track, "frames": FRAMES, "columns": COLUMNS}
    facts |= {"actions": base64.b64encode(drive.actions.astype("<f4").tobytes()).decode()}
    (DATA / "drive.json").write_text(json.dumps(facts) + "\n", encoding="utf-8")
    trajectories = [drive, *(record_trajectory(agent, other, FRAMES) for other in others)]
    latents = {variant: describe_latents(variant, trajectories) for variant in VARIANTS}
    text = (
        json.dumps(latents, indent=0).replace("\n}", "}").replace("{\n", "{").replace(',\n"', ', "')
    )
    (DATA / "latents.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
