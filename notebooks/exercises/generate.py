"""Make the student's versions from the instructor's: python notebooks/exercises/generate.py.

nbgrader makes NAME.ipynb of each source/NAME/NAME.ipynb: stubs for solutions, and no outputs.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

from nbgrader.apps import NbGraderAPI
from traitlets.config.loader import PyFileConfigLoader

COURSE = Path(__file__).parent


def load_course(root: Path) -> NbGraderAPI:
    """nbgrader for the course in the folder `root`, configured by its nbgrader_config.py."""
    # nbgrader calls `alembic` by name: without an activated environment it is not on the PATH.
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return NbGraderAPI(config=PyFileConfigLoader("nbgrader_config.py", str(root)).load_config())


def generate(target: Path) -> list[Path]:
    """Write the student's versions into the folder `target`; returns their paths.

    nbgrader works in a copy of the course, so that no gradebook is left here.

    Raises:
        RuntimeError: nbgrader refuses a source notebook; its log says why.
    """
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        shutil.copytree(COURSE / "source", root / "source", ignore=shutil.ignore_patterns(".*"))
        shutil.copy(COURSE / "nbgrader_config.py", root)
        course, made = load_course(root), []
        for source in sorted((root / "source").iterdir()):
            result = course.generate_assignment(source.name)
            if not result["success"]:
                raise RuntimeError(f"nbgrader could not make {source.name}:\n{result['log']}")
            student = root / "release" / source.name / f"{source.name}.ipynb"
            made.append(Path(shutil.copy(student, target)))
    return made


if __name__ == "__main__":
    for path in generate(Path(sys.argv[1]) if sys.argv[1:] else COURSE):
        print(path)
