"""Experiments: those that are declared are those that were run."""

import pytest

from stad_study import tables
from stad_study.experiments import EXPERIMENTS, find_experiment


def test_every_run_in_the_tables_has_the_configuration_that_is_declared():
    for _, run in (
        tables.read("runs").query("role == 'run'").dropna(subset="config.seed").iterrows()
    ):
        config = EXPERIMENTS[run["experiment"]].config_of(run["seed"]).as_dict()
        assert run["variant"] == config.pop("variant")
        declared = tables.flatten(config, "config.")
        assert run[list(declared)].to_dict() == declared


def test_an_unknown_experiment_or_seed_is_refused():
    assert find_experiment("no_bar_frame", [1, 1]).seeds == (1,)
    with pytest.raises(ValueError, match="unknown experiment 'bar'"):
        find_experiment("bar")
    with pytest.raises(ValueError, match="no seed 7"):
        find_experiment("no_bar_frame", [0, 7])
