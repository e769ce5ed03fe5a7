"""The environment check: is everything here that the notebooks need, and what to do about what is not.

It must be able to run where things are broken, so nothing but the standard library is imported before it is looked for.
`python -m stad_lab check` prints it; in a notebook, `check_environment()` at the end of a cell shows it.
"""

import importlib
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

GREEN, AMBER, RED = "green", "amber", "red"
COLORS = {GREEN: "#009E73", AMBER: "#E69F00", RED: "#D55E00"}
INSTALL = "pip install -r environment.txt, in the environment that this Python belongs to"
LIMITS = Path("/sys/fs/cgroup")  # of a container, on Linux
MODULES = (
    *(
        "numpy",
        "cv2",
        "torch",
        "gymnasium",
        "Box2D",
        "pygame",
        "cma",
        "sklearn",
        "scipy",
        "safetensors",
    ),
    *("matplotlib", "PIL", "ipywidgets"),
)


@dataclass(frozen=True)
class Line:
    """One line of the check."""

    state: str
    """"green" (as it should be), "amber" (works, with a drawback) or "red" (some notebook will fail)."""
    name: str
    """What was looked at."""
    found: str
    """What was found."""
    remedy: str = ""
    """What to do; empty for green."""


@dataclass(frozen=True)
class Report:
    """All lines of the check; prints as text in a terminal, and as a table in a notebook."""

    lines: tuple[Line, ...]

    @property
    def ok(self) -> bool:
        """Whether no line is red."""
        return all(line.state != RED for line in self.lines)

    @property
    def summary(self) -> str:
        """One sentence on the whole."""
        counts = [(sum(line.state == state for line in self.lines), state) for state in COLORS]
        counted = ", ".join(f"{count} {state}" for count, state in counts if count)
        verdict = (
            "everything needed is here"
            if self.ok
            else "follow the remedies of the red lines, then run this again"
        )
        return f"{counted}: {verdict}"

    def __str__(self) -> str:
        width = max(len(line.name) for line in self.lines)
        texts = []
        for line in self.lines:
            texts.append(f"{line.state:6s} {line.name:{width}s}  {line.found}")
            if line.remedy:
                texts.append(f"{'':6s} {'':{width}s}  remedy: {line.remedy}")
        return "\n".join([*texts, self.summary])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The summary, and a table that stands open if a line is not green. No colour of its own for text or ground."""
        rows = []
        for line in self.lines:
            remedy = f"<br><b>{escape(line.remedy)}</b>" if line.remedy else ""
            mark = f'<span style="color: {COLORS[line.state]}">&#9679;</span> {line.state}'
            cells = (mark, escape(line.name), escape(line.found) + remedy)
            rows.append(
                "<tr>"
                + "".join(f'<td style="text-align: left">{cell}</td>' for cell in cells)
                + "</tr>"
            )
        opened = "" if all(line.state == GREEN for line in self.lines) else " open"
        return f"<details{opened}><summary>{escape(self.summary)}</summary><table>{''.join(rows)}</table></details>"


def check_environment(folder: str | Path = ".") -> Report:
    """Look at the versions, Box2D and the pictures, the weights, the machine, the folder and the widgets.

    Nothing that is missing or broken stops it: what a check raises becomes its red line. Most of its time goes into
    importing what the notebooks will import anyway.

    Args:
        folder: where you work: looked at for space and for the right to write.
    """
    checks = (
        check_python,
        check_packages,
        check_imports,
        check_settings,
        check_weights,
        check_drive,
    )
    checks += (check_processors, check_memory, check_gpu, check_widgets)
    lines = [line for check in checks for line in attempt(check)]
    return Report((*lines, *attempt(check_folder, Path(folder))))


def tell_environment() -> int:
    """Print what `check_environment` finds; returns what the command ends with, 0 if all is well."""
    print(report := check_environment())
    return 0 if report.ok else 1


def escape_foreign_letters() -> None:
    """From now on print letters that the console does not have, of a folder's name for example, as escapes."""
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")


def attempt(check: Callable[..., Iterator[Line]], *arguments) -> list[Line]:
    """The lines of a check; whatever it raises is one more line, a red one."""
    lines = []
    try:
        lines.extend(check(*arguments))
    except Exception as error:  # a broken library may raise anything
        name = check.__name__.removeprefix("check_")
        lines.append(Line(RED, name, f"{type(error).__name__}: {error}", INSTALL))
    return lines


def check_python() -> Iterator[Line]:
    """Python's own version, against what stad_lab asks for."""
    try:
        wanted = metadata("stad_lab")["Requires-Python"]
    except PackageNotFoundError:
        yield Line(RED, "stad_lab", f"not installed for {sys.executable}", INSTALL)
        return
    yield Line(GREEN, "stad_lab", version("stad_lab"))
    found = platform.python_version().rstrip(
        "+"
    )  # of a build from a branch, 3.12.3+: as good as 3.12.3
    yield compare("Python", found, wanted, f"make a new environment with a Python {wanted}")


def check_packages() -> Iterator[Line]:
    """The installed version of every requirement."""
    from packaging.requirements import Requirement

    for requirement in map(Requirement, requires("stad_lab")):
        if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(requirement.name)
        except PackageNotFoundError:
            yield Line(RED, requirement.name, f"missing for {sys.executable}", INSTALL)
        else:
            yield compare(requirement.name, found, str(requirement.specifier), INSTALL)
    try:
        found = version("box2d-py")
    except PackageNotFoundError:
        return
    remedy = "pip uninstall box2d-py box2d, then " + INSTALL
    yield Line(
        RED,
        "box2d-py",
        f"{found}, which is installed over the same module `Box2D` as box2d",
        remedy,
    )


def compare(name: str, found: str, wanted: str, remedy: str) -> Line:
    """A line on a version: green if `found` fulfils `wanted`, for example ">=1.2,<2"."""
    from packaging.specifiers import SpecifierSet

    if SpecifierSet(wanted).contains(found, prereleases=True):
        return Line(GREEN, name, found)
    return Line(RED, name, f"{found}, but stad_lab wants {wanted}", remedy)


def check_imports() -> Iterator[Line]:
    """Whether the libraries not only lie there, but load."""
    broken = 0
    for module in MODULES:
        try:
            importlib.import_module(module)
        except Exception as error:  # OSError for a missing system library, for example
            broken += 1
            yield Line(RED, f"import {module}", f"{type(error).__name__}: {error}", INSTALL)
    if not broken:
        yield Line(GREEN, "imports", f"all {len(MODULES)} libraries load")


def check_settings() -> Iterator[Line]:
    """The preset that $STAD_LAB_SETTINGS names."""
    from stad_lab.config import ENVIRONMENT_VARIABLE, PRESETS, Settings

    try:
        yield Line(GREEN, "settings", Settings.preset().name)
    except ValueError as error:
        yield Line(
            RED,
            "settings",
            str(error),
            f"set {ENVIRONMENT_VARIABLE} to one of {', '.join(PRESETS)}, or unset it",
        )


def check_weights() -> Iterator[Line]:
    """The trained weights that come with stad_lab."""
    files = sorted(Path(__file__).with_name("pretrained").rglob("*.safetensors"))
    small = [
        file.name for file in files if file.stat().st_size < 500
    ]  # a pointer of Git LFS, or half a download
    if not files or small:
        found = f"truncated: {', '.join(small)}" if small else "none in stad_lab/pretrained"
        yield Line(RED, "weights", found, "download or clone the whole of stad_lab again")
    else:
        yield Line(
            GREEN,
            "weights",
            f"{len(files)} files, {sum(file.stat().st_size for file in files) / 1e6:.0f} MB",
        )


def check_drive() -> Iterator[Line]:
    """A real reset and step of CarRacing-v3 with both renderers, and a look at the pictures."""
    import numpy as np

    from stad_lab.envs.car_racing import make_env

    for name, fast in (("CarRacing, fast", True), ("CarRacing, Gymnasium's", False)):
        env = make_env(fast=fast)
        observation, _ = env.reset(seed=1)
        observation, *_ = env.step(np.array([0.0, 0.5, 0.0], np.float32))
        env.close()
        colors = len(np.unique(observation.reshape(-1, 3), axis=0))
        found = f"Box2D drives; picture {observation.shape}, {colors} colours, mean {observation.mean():.0f} of 255"
        black = observation.mean() < 10 or colors < 5
        remedy = (
            "reinstall the renderer: pip install --force-reinstall pygame-ce opencv-python-headless"
        )
        yield Line(RED, name, found + ": black", remedy) if black else Line(GREEN, name, found)


def check_processors() -> Iterator[Line]:
    """Processor cores that this process may use, and whether others keep them busy."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    limit = LIMITS / "cpu.max"
    quota, _, period = limit.read_text().partition(" ") if limit.exists() else ("max", "", "")
    allowed = max(1, int(quota) // int(period)) if quota.isdigit() else cores
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    remedy = "close other programs; on a shared machine, set OMP_NUM_THREADS=1 before you start JupyterLab"
    if (
        load > 2 * cores and os.environ.get("OMP_NUM_THREADS") != "1"
    ):  # PyTorch's threads then wait for each other
        yield Line(
            AMBER, "cores", f"{cores}, and on average {load:.0f} processes want them", remedy
        )
    elif allowed < cores and not os.environ.get(
        "OMP_NUM_THREADS"
    ):  # as many threads as cores, and few may run
        remedy = f"set OMP_NUM_THREADS={allowed} before you start JupyterLab"
        yield Line(AMBER, "cores", f"{cores}, of which the container may use {allowed}", remedy)
    elif cores == 1:
        yield Line(
            AMBER,
            "cores",
            "1",
            "all works, at half the stated speed or less: add --set processes=1 to train",
        )
    else:
        yield Line(GREEN, "cores", f"{cores}")


def check_memory() -> Iterator[Line]:
    """Memory that is free, within the limit of a container where there is one."""
    import psutil

    free = psutil.virtual_memory().available
    limit, used, statistics = (LIMITS / f"memory.{name}" for name in ("max", "current", "stat"))
    if limit.exists() and limit.read_text().strip().isdigit():
        # Pages of files that were read count as used there, though the system gives them back when they are wanted.
        counts = (
            dict(line.split() for line in statistics.read_text().splitlines())
            if statistics.exists()
            else {}
        )
        free = min(
            free,
            int(limit.read_text()) - int(used.read_text()) + int(counts.get("inactive_file", 0)),
        )
    remedy = "close other programs and shut down notebooks that you no longer use (Kernel > Shut Down All Kernels)"
    yield graded("free memory", free / 1e9, amber=2.0, red=0.7, remedy=remedy)


def check_folder(folder: Path) -> Iterator[Line]:
    """Space on the disk of the working folder, and the right to write there."""
    if not folder.is_dir():
        yield Line(
            RED,
            "working folder",
            f"{folder}: there is no such folder",
            "make it, or name another one",
        )
        return
    remedy = "make room, or work on another disk; random episodes of the laptop settings take up to 1.4 GB"
    yield graded(
        "free disk", shutil.disk_usage(folder).free / 1e9, amber=3.0, red=0.3, remedy=remedy
    )
    try:
        with tempfile.TemporaryFile(dir=folder):
            yield Line(GREEN, "working folder", "may be written to")
    except OSError as error:
        yield Line(
            RED,
            "working folder",
            f"{folder.resolve()}: {error}",
            "copy the notebooks to a folder of your own",
        )


def graded(name: str, found: float, amber: float, red: float, remedy: str) -> Line:
    """A line on gigabytes: green from `amber` on, red below `red`."""
    state = GREEN if found >= amber else AMBER if found >= red else RED
    return Line(state, name, f"{found:.1f} GB", "" if state == GREEN else remedy)


def check_gpu() -> Iterator[Line]:
    """A GPU is never needed; where there is one, V and M train on it."""
    import torch

    if not torch.cuda.is_available():
        yield Line(GREEN, "GPU", "none, and none is needed")
        return
    name = "there is one that"  # until it tells its name
    try:
        name, (major, minor) = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
        nvidia = [kind for kind in torch.cuda.get_arch_list() if kind.startswith("sm_")]
        built = [int(kind[3:].rstrip("af")) for kind in nvidia]
        if built and 10 * major + minor < min(built):
            remedy = "none is needed; for this one install a PyTorch that is built for an older CUDA, see pytorch.org"
            yield Line(
                AMBER,
                "GPU",
                f"{name} is too old for this PyTorch: V and M train on the CPU",
                remedy,
            )
            return
        torch.ones(1, device="cuda").add_(1).item()  # as `training.training_device` does
        yield Line(GREEN, "GPU", name)
    except (RuntimeError, AssertionError) as error:
        remedy = "none is needed; see whether another process has taken it"
        yield Line(
            AMBER, "GPU", f"{name} cannot be used now, so V and M train on the CPU: {error}", remedy
        )


def check_widgets() -> Iterator[Line]:
    """Whether JupyterLab, if started from this environment, can show sliders."""
    from jupyter_core.paths import jupyter_path

    folders = [
        Path(folder, "@jupyter-widgets", "jupyterlab-manager")
        for folder in jupyter_path("labextensions")
    ]
    if any(folder.exists() for folder in folders):
        yield Line(
            GREEN,
            "widgets",
            f"JupyterLab's widget manager {version('jupyterlab_widgets')} is installed",
        )
    else:
        remedy = "pip install --force-reinstall jupyterlab_widgets, then start JupyterLab anew; the figures show without it"
        yield Line(
            AMBER,
            "widgets",
            "JupyterLab's widget manager is missing: sliders stay invisible",
            remedy,
        )
