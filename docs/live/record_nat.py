"""Record the data of the live page *The KL weight*: V with eight KL weights.

    python docs/live/record_nat.py --work runs/nat

Trains V with each KL weight of KL_WEIGHTS on a small dataset of the random driver (about twenty
minutes), measures rate and distortion on episodes that no V has seen, and writes docs/live/data:

    nat.json    the measurements, one entry for each KL weight
    nat.webp    for each shown frame a row of pictures, the frame and then its reconstructions, and
                below it such a row of its difference images

An interrupted run continues where it stopped.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image

from stad_lab.config import Config
from stad_lab.envs.frames import difference_image, earlier_frames
from stad_lab.evaluation.metrics import reconstruct, vae_metrics
from stad_lab.evaluation.probe_run import random_trajectories
from stad_lab.io.weights import VAE_FILE, load_vae
from stad_lab.training.pipeline import train
from stad_lab.viz.plots import difference_colors

DATA = Path(__file__).parent / "data"
KL_WEIGHTS = (0.02, 0.08, 0.25, 1.0, 2.0, 4.0, 8.0, 16.0)
CONFIG = Config.preset(
    "laptop",
    variant="input_output",
    processes=1,
    data={"episodes": 300},
    vae={"steps": 1000, "batch": 64},
)
MEASURED, SEED = 24, 1  # trajectories on which V is measured, and their seed
SHOWN = ((0, 17), (2, 17), (13, 35), (5, 29), (17, 36))  # of which trajectory which frame


def train_all(work: Path) -> None:
    """Train one V for each KL weight, first those in the middle of the curve."""
    for weight in sorted(KL_WEIGHTS, key=lambda weight: abs(np.log(weight / 0.5))):
        config = CONFIG.replace(vae={"kl_weight": weight})
        train(config, work / f"kl_{weight:g}", work / "dataset", until="vae")


def measure(work: Path) -> tuple[list[dict], np.ndarray]:
    """Measure every V, and let it reconstruct the shown frames: measurements, and the picture."""
    driven = random_trajectories(MEASURED, SEED, CONFIG.processes)
    stride, crop_bar = CONFIG.vae.stride, CONFIG.data.crop_bar
    films = [one.frames(crop_bar) for one in driven]
    before = [earlier_frames(film, stride) for film in films]
    every = [np.concatenate([film[stride::3] for film in part]) for part in (films, before)]
    shown = [np.array([part[film][t] for film, t in SHOWN]) for part in (films, before)]
    columns, found = [column(shown[0], difference_image(*shown))], []
    for weight in KL_WEIGHTS:
        vae, _ = load_vae(work / f"kl_{weight:g}" / VAE_FILE)
        measured = vae_metrics(vae, *every)
        kept = {
            name: round(measured[name], 2) for name in ("frame_error", "difference_error", "kl")
        }
        kl = [round(value, 3) for value in measured["kl_of_latents"]]
        found.append({"kl_weight": weight, **kept, "kl_of_latents": kl})
        decoded = reconstruct(vae, *shown)
        frames = (decoded.frames * 255).round().astype(np.uint8)
        columns.append(column(frames, decoded.differences))
    return found, np.concatenate(columns, axis=1)


def column(frames: np.ndarray, differences: np.ndarray) -> np.ndarray:
    """Each frame above its difference image in colours, uint8 (2 * 64 * frames, 64, 3)."""
    pairs = np.stack([frames, difference_colors(differences)], axis=1)
    return pairs.reshape(-1, *frames.shape[2:])


def main(work: Path) -> None:
    """Train, measure and write."""
    train_all(work)
    found, picture = measure(work)
    DATA.mkdir(exist_ok=True)
    Image.fromarray(picture).save(DATA / "nat.webp", lossless=True, quality=100, method=6)
    text = json.dumps({"frames": len(SHOWN), "networks": found})
    (DATA / "nat.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, default=Path("runs/nat"), help="folder of the V")
    main(parser.parse_args().work)
