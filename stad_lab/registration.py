"""Our environments in Gymnasium's registry, without importing Gymnasium for who does not use it."""

import contextlib
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType


def register_environments() -> None:
    """Register by the names of our modules, which Gymnasium imports when an environment is made.

    Without a working Gymnasium the import must still succeed: `stad_course.doctor` says what is
    wrong.
    """
    with contextlib.suppress(Exception):
        from gymnasium import register

        register(
            "StadLab/CarRacing-v3",
            "stad_lab.envs.car_racing:CarRacing",
            vector_entry_point="stad_lab.envs.vector:CarRacingVector",
            reward_threshold=900,
            max_episode_steps=1000,
        )
        register(
            "StadLab/Dream-v0",
            "stad_lab.dreaming:make_dream",
            vector_entry_point="stad_lab.dreaming:make_dreams",
        )


class RegisterLater:
    """Registers our environments as soon as somebody imports Gymnasium.

    It stands in `sys.meta_path`, where Python asks for the loader of every module.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: object = None
    ) -> ModuleSpec | None:
        """Gymnasium's own spec, whose loader registers, too; None for any other module."""
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)  # so that the others are asked
        try:
            spec = importlib.util.find_spec(name)
        finally:
            sys.meta_path.insert(0, self)  # to ask for a spec is not yet to import
        if spec and spec.loader:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                sys.meta_path.remove(self)
                register_environments()

            spec.loader.exec_module = load_and_register  # type: ignore[method-assign]  # on purpose
        return spec


def register_when_used() -> None:
    """Register now if Gymnasium is loaded, otherwise when it is."""
    if "gymnasium" in sys.modules:
        register_environments()
    else:
        sys.meta_path.insert(0, RegisterLater())
