"""Study 3: probes what V and M of study 1 carry of the car's motion, from what is kept of them.

Every seed has the V and M of its variants, and two untrained pairs as controls: of `frame`, whose
input is also that of `output`, and of `input_output`, whose input is also that of `input`. All are
probed on the same trajectories of two drivers.
"""

from collections.abc import Sequence
from pathlib import Path

import pandas
from tqdm import tqdm

from stad_lab.evaluation.probe_run import (
    PROBE_SEED,
    PROBED,
    Encoder,
    encoder_of,
    probe_trajectories,
    random_trajectories,
    two_drivers,
)
from stad_lab.io.files import checksum, locked
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training.trainer import torch_settings
from stad_study import tables
from stad_study.networks import NETWORKS, find_world_model, load_kept_world_model
from stad_study.study import (
    STUDIES,
    WAIT,
    Pipeline,
    check_kept,
    find_pipelines,
    fixed_threads,
    recorded,
)

CONTROLS = ("frame", "input_output")
DRIVERS = {"random driver": "random_driver", "trained agent": "agent"}  # names in the table


def probe_study(
    study: str,
    seeds: Sequence[int] | None = None,
    to: Path = tables.DATA,
    networks: Path = NETWORKS,
    trajectories: int = PROBED,
    processes: int = 2,
) -> list[int]:
    """Probe the complete seeds that the table lacks, and add each to it; returns their numbers.

    After an interruption the same call continues. ValueError as `find_pipelines` and `check_kept`,
    and for a kept file with another checksum than in the table of runs; FileNotFoundError for one
    that is missing.
    """
    missing = seeds_to_probe(study, seeds, to)
    kept = {seed: kept_world_models(study, seed, to, networks) for seed in missing}
    if not missing:
        return []
    random = random_trajectories(trajectories, PROBE_SEED, processes)
    drivers = two_drivers(random, processes)
    for seed in missing:
        models = {one: load_kept_world_model(file) for one, file in kept[seed].items()}
        encoders = {
            (one, True): encoder_of(model, {"z, h": model.mdn_rnn}) for one, model in models.items()
        }
        encoders |= {(one, False): untrained(study, one, seed) for one in CONTROLS}
        lines = []
        with fixed_threads():
            for (variant, trained), encoder in tqdm(encoders.items(), f"seed {seed}", unit="V"):
                for driver, driven in drivers.items():
                    found = probe_trajectories(*driven, encoder)
                    own = {"variant": variant, "trained": trained, "driver": DRIVERS[driver]}
                    lines += [own | line for line in lines_of(found)]
        with locked(to, WAIT):
            table = pandas.DataFrame(lines).assign(study=study, seed=seed)
            tables.replace_lines("study_probe", table, to)
    return missing


def seeds_to_probe(study: str, seeds: Sequence[int] | None, to: Path) -> list[int]:
    """The seeds whose pipelines are all in the table of runs, and none in that of the probe."""
    wanted = find_pipelines(study, seeds)
    check_kept(study)
    complete = set(STUDIES[study].seeds) - {one.seed for one in wanted if recorded(one, to) is None}
    table = tables.read_study("probe", to)
    done = set(table.loc[table["study"] == study, "seed"])
    return [seed for seed in dict.fromkeys(one.seed for one in wanted) if seed in complete - done]


def kept_world_models(study: str, seed: int, to: Path, networks: Path) -> dict[str, Path]:
    """Variant -> file of its kept V and M, whose checksum is that in the table of runs."""
    files = {}
    for variant in STUDIES[study].variants:
        pipeline = Pipeline(study, variant, STUDIES[study].features[0], seed)
        files[variant] = find_world_model(networks, study, seed, variant)
        line = recorded(pipeline, to) or {}
        if checksum(files[variant].read_bytes()) != line.get("kept_world_model"):
            raise ValueError(f"{files[variant]} is not the file of the recorded run")
    return files


def untrained(study: str, variant: str, seed: int) -> Encoder:
    """V and M of a study's sizes with random weights, which depend on the seed."""
    config = STUDIES[study].config
    with torch_settings(seed, 0):
        vae, mdn_rnn = VAE.of(config.replace(variant=variant)), MDNRNN.of(config)
    return Encoder(vae, config.vae.stride, config.data.crop_bar, {"z, h": mdn_rnn})


def lines_of(found: dict) -> list[dict]:
    """What `probe_trajectories` found, a line for each features and quantity."""
    return [
        {"features": features, "quantity": quantity, "r2": one["r2"]}
        | dict(zip(("low", "high"), one["interval"], strict=True))
        for features, by_quantity in found.items()
        for quantity, one in by_quantity.items()
    ]
