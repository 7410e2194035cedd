"""The run whose clones the trials of a sweep are."""

from types import SimpleNamespace

from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.runs.files import read_object
from sweeps.sweep import _parent

LR = "algorithm.lr=tag(log,interval(1e-5,1e-3))"


def test_the_parent_is_resolved_when_a_study_is_begun_and_stays_the_same(trained):
    folder = trained().folder
    runs_dir = folder.parents[1]
    request = compose_sweep(["study=p", "parent=best:tiny", LR])
    best = read_object(folder / "summary.json")["best"]["iteration"]
    found = _parent(request, runs_dir, None)
    assert found == (f"run={folder.resolve()}", f"checkpoint={best}")
    # Something better, trained since, changes nothing for a study that has begun.
    begun = SimpleNamespace(user_attrs={"parent": "best:tiny", "parent_run": ["run=/a", "checkpoint=3"]})
    assert _parent(request, runs_dir, begun) == ("run=/a", "checkpoint=3")
    asks_for_another = SimpleNamespace(user_attrs=begun.user_attrs | {"parent": "best:other"})
    assert _parent(request, runs_dir, asks_for_another) == found
    assert _parent(compose_sweep(["study=p", LR]), runs_dir, None) == ()
