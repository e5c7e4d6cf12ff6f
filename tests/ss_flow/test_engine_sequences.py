"""Lists of results: read item by item, in part, by position, and as long as a run finds them."""

from __future__ import annotations

import pytest
import ss_flow_toy as toy
from toy_runs import ran, run, value

from ss_flow.cache.store import Store
from ss_flow.graph import INDEX, each, expand, labelled, pick


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_sequence_is_read_item_by_item(store, executor):
    def flow():
        return {"total": toy.streamed_total(toy.source(values=(1.0, 2.0, 3.0)))}

    report = run(store, flow, executor=executor)
    assert value(store, report.values["total"]) == (1 + 2 + 3) + (1 + 3) + 3


def test_who_gets_some_of_a_list_does_not_depend_on_the_others(store):
    def flow(*values: float):
        xs = toy.source(values=values)
        return {"total": toy.total(pick(xs, [2, 0]))}

    assert value(store, run(store, lambda: flow(1.0, 2.0, 4.0)).values["total"]) == 5
    assert ran(run(store, lambda: flow(1.0, 3.0, 4.0, 8.0))) == ["ss_flow_toy.source"]


def test_each_hands_out_positions(store):
    def flow():
        return {"clipped": each(toy.source(values=(5.0, 5.0)), INDEX, build=lambda x, i: toy.clip(x, limit=float(i)))}

    report = run(store, flow)
    assert [value(store, digest) for digest in report.values["clipped"]] == [0.0, 1.0]


def test_an_item_that_is_lost_while_a_sequence_is_read_is_computed_again(store):
    first = run(store, lambda: {"xs": toy.source(values=(1.0, 2.0, 3.0))})
    path = store.object_path(first.values["xs"][1])
    damaged = next(path.rglob("c.*"), None) or next(p for p in path.rglob("*") if p.is_file())
    damaged.write_bytes(b"")
    report = run(Store(store.root), lambda: {"total": toy.streamed_total(toy.source(values=(1.0, 2.0, 3.0)))})
    assert value(store, report.values["total"]) == 13.0


def test_expand_gets_the_number_of_the_items_of_a_list(store):
    def flow():
        xs = toy.source(values=(1.0, 2.0))
        return {"x": expand(xs, lambda count: toy.clip(xs[0], limit=-float(count)))}

    assert value(store, run(store, flow).values["x"]) == -2.0


def test_a_report_tells_one_output_from_a_list_and_from_a_failure(store):
    report = run(store, lambda: {"xs": (xs := toy.source(values=(1.0, 2.0))), "x": xs[0], "far": xs[5]})
    assert report.all("xs") == report.values["xs"] and report.one("x") == report.all("xs")[0]
    for ask, name, error in (
        (report.one, "xs", TypeError),
        (report.all, "x", TypeError),
        (report.one, "far", IndexError),
    ):
        with pytest.raises(error):
            ask(name)


def test_a_record_does_not_grow_with_the_lists_that_go_in_and_a_list_is_kept_once(store):
    def totals(count):
        numbers = toy.source(values=tuple(float(i) for i in range(count)))
        with labelled("plain"):
            plain = toy.total(numbers)
        with labelled("streamed"):
            return {"plain": plain, "streamed": toy.streamed_total(numbers)}

    sizes = []
    for count in (3, 300):
        report = run(store, lambda count=count: totals(count))
        keys = [n["key"] for n in report.nodes if n["step"] != "ss_flow_toy.source"]
        sizes.append([store.action_path(key).stat().st_size for key in keys])
        inputs = {store.action(key).components["inputs"]["xs"] for key in keys}
        (digest_of_list,) = inputs
        source = next(n for n in report.nodes if n["step"] == "ss_flow_toy.source")
        assert store.part(digest_of_list) == source["outputs"] and len(source["outputs"]) == count
        sizes[-1].sort()
    assert all(abs(few - many) < 20 for few, many in zip(*sizes, strict=True)), sizes
