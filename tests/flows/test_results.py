"""What a finished run says of itself."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.results import FinishedRun, Results, read_run


@pytest.mark.parametrize("results", [{"describe": [""]}, {"describe": ""}, {"describe": None}, ["ab" * 32]])
def test_a_run_json_whose_results_are_no_digests_is_damaged(tmp_path, results):
    document = {"store": str(tmp_path), "scene": "", "params": {}, "results": results}
    (tmp_path / "run.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"run\.json is damaged: its results are no digests"):
        read_run(tmp_path)


def run_of(names, tmp_path):
    entries = [{"id": i, "name": name, "num_gaussians": 5} for i, name in enumerate(names, 1)]
    return FinishedRun(Path("out"), {}, {"instances": entries}, Results(Store(tmp_path / "store"), {}))


def test_of_many_instances_those_like_the_asked_one_are_named_first_and_the_others_counted(tmp_path):
    run = run_of([*(f"box {i}" for i in range(12)), "Red Mug", "mug"], tmp_path)
    assert run.ids(["Red Mug", "0", "2"]) == (0, 2, 13)
    with pytest.raises(InputError) as refused:
        run.ids(["Mug"])
    assert str(refused.value) == (
        "--instance 'Mug' is no instance of out; there are 0 (background), 13 (Red Mug), 14 (mug), 1 (box 0), "
        "2 (box 1), 3 (box 2), 4 (box 3), 5 (box 4), 6 (box 5) and 6 more (instances.json)."
    )


def test_a_few_instances_are_all_named(tmp_path):
    with pytest.raises(InputError, match=r"there are 0 \(background\), 1 \(mug\), 2 \(box\)\.$"):
        run_of(["mug", "box"], tmp_path).ids(["cup"])
