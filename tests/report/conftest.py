"""Runs that were made up, read as the report reads them."""

import pytest
import synthetic

from starjax.report import results


def edited(run, trials=None, about=None, **fields):
    """The run with some of its result changed."""
    result = run.result._replace(**fields, about={**run.result.about, **(about or {})})
    return run._replace(result=result if trials is None else result._replace(trials=tuple(trials)))


@pytest.fixture(scope="session")
def several(tmp_path_factory):
    """DP-EE, DP-RCM-4 and STAR-Diff, each better than the one before, with sweeps."""
    out = tmp_path_factory.mktemp("several")
    skills = {"dp_ee": (0.5, 0.1), "dp_rcm4": (0.8, 0.5), "stardiff": (0.95, 0.8)}
    return [
        results.load(synthetic.run(out / name, name, skill, seed=i, sweep_of=150))
        for i, (name, skill) in enumerate(skills.items())
    ]


@pytest.fixture(scope="session")
def one(several):
    """STAR-Diff, without its sweep."""
    return several[2]._replace(sweep=None)
