"""The viewer's search box and its slider."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import ss_flow

pytest.importorskip("viser", reason="needs the extra `view`")
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import StoreOptions, open_run
from ss_flow.flows.cli.view import search_of
from ss_flow.flows.view.object_list import ObjectList
from ss_flow.flows.view.viewer import Viewer
from ss_flow.tasks.semantics.query import QueryParams, QueryResult, Similarity, chosen


@pytest.fixture
def viewer(tiny, tmp_path: Path) -> Iterator[Viewer]:
    run = open_run(tiny.out, StoreOptions(tiny.store), ("scene", "cameras"))
    viewer = Viewer(run, tmp_path / "script.json", (), search_of(run), port=0)
    yield viewer
    viewer.close()


def _listed(objects: ObjectList) -> list[int]:
    return [row.instance for row in objects.rows]


def test_what_is_typed_is_answered_as_by_the_command(viewer: Viewer, tiny) -> None:
    objects = viewer.panel.objects
    for text in ("red", "green, not red"):
        objects.text.value = text
        found = ss_flow("query", tiny.out, text, "--json", "--cache", tiny.store).document()
        ranked = [entry["id"] for entry in found["instances"]]
        assert _listed(objects) == ranked
        matches = sum(bool(entry["matched"]) for entry in found["instances"])
        assert objects.answer.content == (f"{matches} match" if matches else "Nothing in the scene matches.")
    objects.text.value = "white teapot"
    assert 'Only colour words were understood, not "teapot"' in objects.answer.content
    objects.text.value = ", not"
    assert "nothing follows" in objects.answer.content or "empty" in objects.answer.content


def test_what_is_hardly_a_whole_thing_stands_last(viewer: Viewer) -> None:
    objects = viewer.panel.objects
    first, *others = (i for i in _listed(objects) if i)
    entries = viewer.panel.session.state.objects.entries
    entries[first] = entries[first] | {"confidence": 0.05}
    objects.show()
    assert [i for i in _listed(objects) if i] == [*others, first]


def test_an_object_is_found_by_its_name_too(viewer: Viewer) -> None:
    panel, objects = viewer.panel, viewer.panel.objects
    last = _listed(objects)[-1] or _listed(objects)[-2]
    panel.session.do({"op": "relabel", "instance": last, "name": "Tool box"})
    panel.refresh()
    objects.text.value = "tool"  # no colour word
    assert _listed(objects)[0] == last and objects.answer.content == "1 by name"
    objects.turn.value = "Select matches"
    assert panel.session.selected == (last,)
    objects.text.value = "toolbag"
    assert "names no colour" in objects.answer.content and _listed(objects)[0] != last
    objects.text.value = "red"
    ranked = _listed(objects)
    panel.session.do({"op": "relabel", "instance": ranked[-1], "name": "Red"})
    objects.text.value = "red "
    objects.text.value = "red"
    assert _listed(objects) == [ranked[-1], *ranked[:-1]]


@pytest.mark.parametrize("hidden", [False, True])
def test_what_cannot_be_copied_is_said_to_be_so(viewer: Viewer, hidden: bool) -> None:
    panel = viewer.panel
    panel.session.select(max(panel.session.state.objects.entries) if hidden else 0)
    if hidden:
        panel.session.hide(panel.session.selected)
    with pytest.raises(InputError, match="has Gaussians, and is shown, to copy it"):
        panel._actions()["Duplicate"](None)


class _Scored:
    """Answers with given scores, as a network's are: matters of degree."""

    params = QueryParams()

    def __init__(self, ids: list[int]) -> None:
        self._ids = np.array(ids, np.int32)

    def __call__(self, text: str, tau_corr: float) -> QueryResult:
        score = np.float32(0.3) - np.float32(0.03) * np.arange(len(self._ids), dtype=np.float32)
        none = np.zeros(len(score), np.int32)
        found = Similarity(text, "network", False, self._ids, score, np.ones(len(score), np.float32), none)
        return chosen(found, params=replace(self.params, tau_corr=tau_corr))


def test_the_slider_lets_more_of_them_match(viewer: Viewer) -> None:
    ids = sorted(viewer.panel.session.state.objects.entries)
    picked: list[tuple[int, ...]] = []
    objects = ObjectList(viewer.server.gui, viewer.panel.session, _Scored(ids), picked.append)
    objects.text.value = "mug"
    for tau, matches in ((0.02, 1), (0.05, 2), (0.3, len(ids))):
        objects.tau.value = tau
        assert objects.answer.content == f"{matches} match" and _listed(objects)[: len(ids)] == ids
        objects.turn.value = "Select matches"
        assert picked[-1] == tuple(ids[:matches])


def test_a_click_means_the_object_that_the_page_showed_though_the_list_has_moved_since(viewer: Viewer) -> None:
    panel = viewer.panel
    shown = list(panel.objects.rows)  # by a browser that lags behind
    gone, meant, after = (row.instance for row in shown[:3])
    panel.session.do({"op": "remove", "instances": [gone]})
    panel.refresh()
    assert _listed(panel.objects)[:2] == [meant, after] and [row.button.visible for row in shown[:2]] == [False, True]
    orders = [row.button.order for row in panel.objects.rows]
    assert panel.objects.answer.order < orders[0] and orders == sorted(orders) and orders[-1] < panel.objects.turn.order
    shown[1].button.value = True
    assert panel.session.selected == (meant,)
    shown[0].button.value = True
    assert panel.session.selected == ()
