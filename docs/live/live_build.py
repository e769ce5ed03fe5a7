"""The scripts of the live pages: `write_scripts(folder)`, which the site's build calls.

A page opened from the disk may load scripts, but no other files. So each file of weights or data
becomes a script, `data/NAME.js`, that puts it into `stad.data.NAME`: weights (safetensors) and
pictures as base64, JSON as it is.

Three quarters of V's weights belong to its first two decoding layers, with no nonlinearity between
them. For the pages they are multiplied into one layer, which makes a V of 2.2 MB one of 0.8 MB.
"""

import base64
import gzip
import json
import shutil
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save

from stad_study.study_claims import MARGIN
from stad_study.verdict import PAPER_GAIN

HERE = Path(__file__).parent
PRETRAINED = HERE.parents[1] / "stad_lab" / "pretrained"
CLAIMS = HERE.parents[1] / "stad_study" / "data" / "claims.json"
AGENTS = ("frame", "input", "output", "input_output", "cropped_input")
# What workers run: a page that is opened from the disk cannot give them a file.
NETWORKS = ("layers", "vae", "mdn_rnn", "controller", "agent")
WORKERS = {
    "race": ("engine", *NETWORKS, "random", "hand", "race_worker"),
    "evolve": ("engine", *NETWORKS, "random", "cma_es", "evolution", "evolve_worker"),
}


def fold_decoder(vae: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """V with `decoder.0` (linear) and `decoder.2` (transposed convolution of one pixel) as one.

    The result is `decoder.folded`: z -> rows x columns x channels of the 5 x 5 pixels, float32.
    """
    folded = dict(vae)
    first, bias, kernel, shift = (
        folded.pop(f"decoder.{name}").astype(np.float64)
        for name in ("0.weight", "0.bias", "2.weight", "2.bias")
    )
    weight = np.einsum("iokl,iz->kloz", kernel, first).reshape(-1, first.shape[1])
    offset = (np.einsum("iokl,i->klo", kernel, bias) + shift).reshape(-1)
    folded["decoder.folded.weight"] = weight.astype(np.float32)
    folded["decoder.folded.bias"] = offset.astype(np.float32)
    return folded


def script(name: str, value: object) -> str:
    """A script that puts a value into `stad.data`."""
    return f"(globalThis.stad ??= {{}}).data ??= {{}};\nstad.data.{name} = {json.dumps(value)};\n"


def encoded(content: bytes) -> str:
    """Bytes as base64."""
    return base64.b64encode(content).decode()


def engine() -> dict[str, object]:
    """The compiled engine: module and tables (gzip, base64), facts, and the workers' sources."""
    folder, js = HERE / "engine", HERE / "js"
    packed = {
        name: encoded(gzip.compress((folder / file).read_bytes(), mtime=0))
        for name, file in (("code", "engine.wasm"), ("tables", "tables.bin"))
    }
    sources = {
        worker: "\n".join((js / f"{name}.js").read_text(encoding="utf-8") for name in names)
        for worker, names in WORKERS.items()
    }
    facts = json.loads((folder / "engine.json").read_text(encoding="utf-8"))
    return {**packed, "facts": facts, "sources": sources}


def study() -> dict[str, object]:
    """The primary comparisons of study 1, for the figure of the story."""
    comparisons = json.loads(CLAIMS.read_text(encoding="utf-8"))["study1"]["comparisons"]
    rows = []
    for features, name in (("z, h", "the driver sees z and h"), ("z", "the driver sees z alone")):
        one = comparisons[f"{features}: input_output"]
        pairs = {"interval": one["interval"], "pairs": one["by_seed"]}
        rows.append({"name": name, "difference": one["difference"], **pairs})
    return {"rows": rows, "margin": MARGIN, "paper": PAPER_GAIN}


def data() -> dict[str, object]:
    """Everything that the pages may load: name -> JSON value, weights and pictures as base64."""
    found: dict[str, object] = {"engine": engine(), "study": study()}
    for agent in AGENTS:
        folder = PRETRAINED / agent
        found[f"vae_{agent}"] = encoded(save(fold_decoder(load_file(folder / "vae.safetensors"))))
        for part in ("mdn_rnn", "controller"):
            found[f"{part}_{agent}"] = encoded((folder / f"{part}.safetensors").read_bytes())
    for file in sorted((HERE / "data").iterdir()):
        if file.suffix == ".json":
            found[file.stem] = json.loads(file.read_text(encoding="utf-8"))
        elif file.suffix == ".safetensors":
            found[file.stem] = encoded(file.read_bytes())
        else:
            content = encoded(file.read_bytes())
            found[f"{file.stem}_picture"] = f"data:image/{file.suffix[1:]};base64,{content}"
    return found


def write_scripts(folder: Path) -> None:
    """Write `js`, `data` and one style sheet into the folder of the built pages."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    shutil.copytree(HERE / "js", folder / "js", dirs_exist_ok=True)
    sheets = [sheet.read_text(encoding="utf-8") for sheet in sorted(HERE.glob("*.css"))]
    (folder / "live.css").write_text("\n".join(sheets), encoding="utf-8")
    for name, value in data().items():
        (folder / "data" / f"{name}.js").write_text(script(name, value), encoding="utf-8")
