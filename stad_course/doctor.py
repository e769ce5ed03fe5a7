"""The doctor: is everything here that the notebooks need, and what to do about what is not.

It must run where things are broken, so a check imports what it needs by itself.
"""

import importlib.util
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from html import escape
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from packaging.requirements import Requirement

GREEN, AMBER, RED = "green", "amber", "red"
COLORS = {GREEN: "#009E73", AMBER: "#E69F00", RED: "#D55E00"}
INSTALL = "pip install -r environment.txt, in the environment that this Python belongs to"
LIMITS = Path("/sys/fs/cgroup")  # of a container, on Linux
MODULES = (
    *("numpy", "scipy", "pandas", "cv2", "torch", "gymnasium", "Box2D", "pygame", "cma"),
    *("safetensors", "psutil", "tyro", "numba", "tqdm", "filelock", "threadpoolctl"),
    *("matplotlib", "PIL", "ipywidgets"),
)
COLAB = "google.colab" in sys.modules  # its own notebook packages are older, and do
NEEDED = ("", "train") if COLAB else ("", "train", "lab")  # without which a notebook does not run
OPTIONAL_MODULES = ("distributed",)  # of the other extras


@dataclass(frozen=True)
class Line:
    """One line of the report; its state is "green", "amber" (a drawback) or "red" (a failure)."""

    state: str
    name: str
    found: str
    remedy: str = ""


def judge(good: bool, name: str, found: str, remedy: str, bad: str = RED) -> Line:
    """A green line, or one of the state `bad` with its remedy."""
    return Line(GREEN, name, found) if good else Line(bad, name, found, remedy)


@dataclass(frozen=True)
class Report:
    """All lines; prints as text in a terminal, and as a table in a notebook."""

    lines: tuple[Line, ...]

    @property
    def ok(self) -> bool:
        """Whether no line is red."""
        return all(line.state != RED for line in self.lines)

    @property
    def summary(self) -> str:
        """One sentence on the whole."""
        states = [line.state for line in self.lines]
        counted = ", ".join(f"{states.count(one)} {one}" for one in COLORS if one in states)
        advice = "follow the remedies of the red lines, then run this again"
        return f"{counted}: {'everything needed is here' if self.ok else advice}"

    def __str__(self) -> str:
        width, texts = max(len(line.name) for line in self.lines), []
        for line in self.lines:
            texts.append(f"{line.state:6s} {line.name:{width}s}  {line.found}")
            if line.remedy:
                texts.append(f"{'':{width + 7}s}  remedy: {line.remedy}")
        return "\n".join([*texts, self.summary])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The summary, and a table that is open if a line is red.

        Text and background are the page's.
        """
        rows = ""
        for line in self.lines:
            remedy = f"<br><b>{escape(line.remedy)}</b>" if line.remedy else ""
            mark = f'<span style="color: {COLORS[line.state]}">&#9679;</span> {line.state}'
            cells = (mark, escape(line.name), escape(line.found) + remedy)
            rows += "".join(["<tr>", *(f'<td align="left">{cell}</td>' for cell in cells), "</tr>"])
        opened = "" if self.ok else " open"
        summary = f"<summary>{escape(self.summary)}</summary>"
        return f"<details{opened}>{summary}<table>{rows}</table></details>"


def check_environment(folder: str | Path = ".") -> Report:
    """Look at everything, `folder` being where you work; a check that raises gives a red line."""
    checks = (check_python, check_packages, check_extras, check_imports, check_preset)
    further = (check_weights, check_drive, check_processors, check_memory, check_gpu, check_widgets)
    lines = [line for check in (*checks, *further) for line in attempt(check)]
    return Report((*lines, *attempt(check_folder, Path(folder))))


def tell_environment() -> int:
    """Print what `check_environment` finds; returns the exit status, 0 if nothing is red."""
    print(report := check_environment())
    return 0 if report.ok else 1


def attempt(check: Callable[..., Iterator[Line]], *arguments) -> list[Line]:
    """The lines of a check; whatever it raises is one more line, a red one."""
    lines: list[Line] = []
    try:
        lines.extend(check(*arguments))
    except Exception as error:  # a broken library may raise anything
        name = check.__name__.removeprefix("check_")
        lines.append(Line(RED, name, f"{type(error).__name__}: {error}", INSTALL))
    return lines


def check_python() -> Iterator[Line]:
    """Python's own version, against the one that stad_lab needs."""
    try:
        wanted = metadata("stad_lab")["Requires-Python"]
    except PackageNotFoundError:
        found = f"not installed for {sys.executable}, Python {platform.python_version()}"
        yield Line(RED, "stad_lab", found, f"with Python 3.11, 3.12 or 3.13: {INSTALL}")
        return
    yield Line(GREEN, "stad_lab", version("stad_lab"))
    found = platform.python_version().rstrip("+")  # a build from a branch: as good as the release
    yield compare("Python", found, wanted, f"make a new environment with a Python {wanted}")


def check_packages() -> Iterator[Line]:
    """The versions of all packages that the notebooks need."""
    for requirement in requirements(*NEEDED):
        name, wanted = requirement.name, str(requirement.specifier)
        yield compare(name, installed_version(name), wanted, INSTALL)
    if found := installed_version("box2d-py"):
        found += ", which overwrites the module `Box2D` of box2d"
        yield Line(RED, "box2d-py", found, f"pip uninstall box2d-py box2d, then {INSTALL}")


def check_extras() -> Iterator[Line]:
    """Which extras beyond NEEDED are incomplete; one that is wholly absent gives a green line."""
    for extra in metadata("stad_lab").get_all("Provides-Extra") or ():
        if extra in NEEDED:
            continue
        own = {one.name: one.specifier for one in requirements(extra)}
        found = {name: installed_version(name) for name in own}
        lacking = [
            f"{name} ({version or 'missing'})"
            for name, version in found.items()
            if version is None or not own[name].contains(version, prereleases=True)
        ]
        if not any(found.values()):
            yield Line(GREEN, f"extra {extra}", "not installed; no notebook needs it")
            continue
        remedy = f"only if you need this extra: pip install 'stad_lab[{extra}]'"
        text = f"incomplete: {', '.join(lacking)}" if lacking else "complete"
        yield judge(not lacking, f"extra {extra}", text, remedy, AMBER)


def requirements(*extras: str) -> list["Requirement"]:
    """What stad_lab requires with these extras, "" being none; without stad_lab itself."""
    from packaging.requirements import Requirement

    found = []
    for requirement in map(Requirement, requires("stad_lab") or ()):
        marker, always = requirement.marker, "" in extras and not requirement.marker
        if always or (marker and any(marker.evaluate({"extra": extra}) for extra in extras)):
            found.append(requirement)
    return [one for one in found if one.name != "stad_lab"]


def installed_version(name: str) -> str | None:
    """The version of an installed package, or None."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def compare(name: str, found: str | None, wanted: str, remedy: str) -> Line:
    """A line on a version: green if `found` fulfils `wanted`, for example ">=1.2,<2"."""
    from packaging.specifiers import SpecifierSet

    if found is None:
        return Line(RED, name, f"missing for {sys.executable}", remedy)
    good = SpecifierSet(wanted).contains(found, prereleases=True)
    return judge(good, name, found if good else f"{found}, but stad_lab needs {wanted}", remedy)


def check_imports() -> Iterator[Line]:
    """Whether the installed libraries load."""
    broken = 0
    optional = [module for module in OPTIONAL_MODULES if importlib.util.find_spec(module)]
    for module in (*MODULES, *optional):
        try:
            importlib.import_module(module)
        except Exception as error:  # OSError for a missing system library, for example
            broken += 1
            state = AMBER if module in optional else RED
            yield Line(state, f"import {module}", f"{type(error).__name__}: {error}", INSTALL)
    if not broken:
        yield Line(GREEN, "imports", f"all {len(MODULES) + len(optional)} libraries load")


def check_preset() -> Iterator[Line]:
    """The preset that the environment variable STAD_LAB_PRESET names."""
    from stad_lab.config import PRESET_VARIABLE, PRESETS, Config

    try:
        Config.preset()
        yield Line(GREEN, "preset", os.environ.get(PRESET_VARIABLE) or "laptop")
    except ValueError as error:
        remedy = f"set {PRESET_VARIABLE} to one of {', '.join(PRESETS)}, or unset it"
        yield Line(RED, "preset", str(error), remedy)


def check_weights() -> Iterator[Line]:
    """The trained weights that come with stad_lab."""
    import stad_lab

    files = sorted(Path(stad_lab.__file__).with_name("pretrained").rglob("*.safetensors"))
    # A pointer of Git LFS, or an incomplete download:
    small = [f"{file.parent.name}/{file.name}" for file in files if file.stat().st_size < 500]
    size = sum(file.stat().st_size for file in files) / 1e6
    found = f"truncated: {', '.join(small)}" if small else f"{len(files)} files, {size:.0f} MB"
    remedy = "download or clone the whole of stad_lab again"
    yield judge(bool(files) and not small, "weights", found, remedy)


def check_drive() -> Iterator[Line]:
    """A reset and a step of CarRacing-v3 with each renderer, and whether the picture is black."""
    import numpy as np

    from stad_lab.envs.car_racing import make_env

    remedy = "pip install --force-reinstall pygame-ce opencv-python-headless"
    for name, fast in (("fast renderer", True), ("Gymnasium's renderer", False)):
        env = make_env(fast=fast)
        env.reset(seed=1)
        observation, *_ = env.step(np.array([0.0, 0.5, 0.0], np.float32))
        env.close()
        colors = len(np.unique(observation.reshape(-1, 3), axis=0))
        found = f"picture {observation.shape}, {colors} colours, mean {observation.mean():.0f}"
        black = observation.mean() < 10 or colors < 5
        yield judge(not black, name, f"{found}: black" if black else found, remedy)


def check_processors() -> Iterator[Line]:
    """Cores that this process may use, and whether others keep them busy."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    cores = count or 1
    limit = LIMITS / "cpu.max"
    quota, _, period = limit.read_text().partition(" ") if limit.exists() else ("max", "", "")
    allowed = max(1, int(quota) // int(period)) if quota.isdigit() else cores
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    threads = os.environ.get("OMP_NUM_THREADS")
    if load > 2 * cores and threads != "1":  # PyTorch's threads then wait for each other
        remedy = "close other programs; on a shared machine start JupyterLab with OMP_NUM_THREADS=1"
        yield Line(AMBER, "cores", f"{cores}, for {load:.0f} busy processes", remedy)
    elif allowed < cores and not threads:  # PyTorch would start as many threads as cores
        remedy = f"set OMP_NUM_THREADS={allowed} before you start JupyterLab"
        yield Line(AMBER, "cores", f"{cores}, of which the container may use {allowed}", remedy)
    else:
        remedy = "all works, more slowly: add --processes 1 to train"
        yield judge(cores > 1, "cores", f"{cores}", remedy, AMBER)


def check_memory() -> Iterator[Line]:
    """Memory that is free, within the limit of a container."""
    import psutil

    free = psutil.virtual_memory().available
    limit, used, statistics = (LIMITS / f"memory.{name}" for name in ("max", "current", "stat"))
    if limit.exists() and limit.read_text().strip().isdigit():
        # Files that were read count as used there, but the system frees their pages when needed.
        lines = statistics.read_text().splitlines() if statistics.exists() else []
        cached = int(dict(line.split() for line in lines).get("inactive_file", 0))
        free = min(free, int(limit.read_text()) - int(used.read_text()) + cached)
    remedy = "close other programs, and notebooks (Kernel > Shut Down All Kernels)"
    yield graded("free memory", free / 1e9, amber=2.0, red=0.7, remedy=remedy)


def check_folder(folder: Path) -> Iterator[Line]:
    """Space on the disk of the working folder, and the right to write there."""
    if not folder.is_dir():
        yield Line(RED, "working folder", f"{folder}: there is no such folder", "make it")
        return
    remedy = "make room, or work on another disk: a laptop training takes up to 1.4 GB"
    free = shutil.disk_usage(folder).free / 1e9
    yield graded("free disk", free, amber=3.0, red=0.3, remedy=remedy)
    try:
        with tempfile.TemporaryFile(dir=folder):
            yield Line(GREEN, "working folder", "may be written to")
    except OSError as error:
        remedy = "copy the notebooks to a folder of your own"
        yield Line(RED, "working folder", f"{folder.resolve()}: {error}", remedy)


def graded(name: str, found: float, amber: float, red: float, remedy: str) -> Line:
    """A line on gigabytes: green from `amber` on, red below `red`."""
    return judge(found >= amber, name, f"{found:.1f} GB", remedy, AMBER if found >= red else RED)


def check_gpu() -> Iterator[Line]:
    """Whether V and M can train on a GPU; none is needed."""
    import torch

    if not torch.cuda.is_available():
        yield Line(GREEN, "GPU", "none, and none is needed")
        return
    name = "a GPU"  # until its name is known
    try:
        name = torch.cuda.get_device_name()
        torch.ones(1, device="cuda").add_(1).item()  # as `trainer.training_device` does
        yield Line(GREEN, "GPU", name)
    except (RuntimeError, AssertionError) as error:  # too old for this PyTorch, or in use
        found = f"{name} cannot be used, so V and M train on the CPU: {error}"
        remedy = "none is needed; end what uses it, or see pytorch.org for an older CUDA"
        yield Line(AMBER, "GPU", found, remedy)


def check_widgets() -> Iterator[Line]:
    """Whether JupyterLab, if started from this environment, can show widgets."""
    if not importlib.util.find_spec("jupyter_core"):
        return  # without notebooks
    from jupyter_core.paths import jupyter_path

    folders = [Path(folder, "@jupyter-widgets") for folder in jupyter_path("labextensions")]
    good = any((folder / "jupyterlab-manager").exists() for folder in folders)
    found = version("jupyterlab_widgets") if good else "is missing: no slider is shown"
    remedy = "pip install --force-reinstall jupyterlab_widgets, then start JupyterLab again"
    yield judge(good, "widgets", f"jupyterlab_widgets {found}", remedy)
