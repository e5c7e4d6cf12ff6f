"""What an artifact is, in words."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_runs import ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows.describe import as_html, facts, provenance, statistics
from ss_flow.tasks.artifacts import Metrics, PointLabels


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.array([0, 1, 2, 5], np.int32), "0 .. 5, mean 2, 25% zero"),
        (np.array([1.5, np.nan, 2.5, np.inf], np.float32), "1.5 .. 2.5, mean 2, 25% NaN, 25% infinite"),
        (np.array([np.nan]), "100% NaN"),
        (np.array([True, False, True, True]), "0.75 true"),
        (np.full(1000, 60000, np.uint16), "60000 .. 60000, mean 6e+04"),
        (np.zeros((0, 3)), ""),
    ],
)
def test_statistics_are_of_what_is_finite_and_name_what_is_not(values, said):
    assert statistics(values) == said


def test_every_field_is_told_with_its_schema():
    found = {fact.name: str(fact) for fact in facts(Metrics({"miou": 0.5}))}
    assert found == {"values": "{'miou': 0.5}"}


def test_what_made_a_result_is_known_by_its_digest(tiny):
    store = Store(tiny.store)
    made = provenance(store, tiny.called.results()["propagate"])
    assert made.node["step"] == "split.propagate" and made.action.key == made.node["key"]
    lines = made.lines()
    assert "points (split.dense)" in lines[1] and "tau_label=" in lines[2] and "numpy=" in lines[3]
    assert provenance(store, "0" * 64) is None


def test_cache_show_tells_statistics_size_and_history(tiny):
    shown = ss_flow("cache", "show", "propagate", "--cache", tiny.store).out
    labels = Store(tiny.store).get(tiny.called.results()["propagate"]).label
    assert f"label: int32 {list(labels.shape)} (" in shown
    assert f"{labels.min()} .. {labels.max()}, mean {labels.mean():.4g}" in shown
    assert "  made by split.propagate (key " in shown and "  stored as " in shown
    assert "parameters: " in shown and "packages: python=" in shown


def test_html_escapes_what_comes_from_outside():
    labels = Metrics({"<script>": 1.0})
    assert "<script>" not in as_html(labels)
    assert "<table>" in as_html(PointLabels(*(np.zeros(3, np.int32),) * 2, 1, *(np.zeros(0, np.int32),) * 3))
