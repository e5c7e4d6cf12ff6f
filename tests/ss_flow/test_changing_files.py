"""Input files that change while they are digested, or between that and their use."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
import ss_flow_toy as toy

from ss_flow.cache import file_digests
from ss_flow.cache.canonical import digest_file
from ss_flow.cache.file_digests import FileDigests
from ss_flow.engine import run_flow
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.task import FileRef


def test_an_input_file_that_changes_after_its_key_was_made_fails_its_step_and_leaves_no_result(store, tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")

    class Changing(Reporter):
        def event(self, kind, **details):
            if (kind, details.get("step")) == ("started", "ss_flow_toy.source"):
                file.write_text("5.0")

    def flow():
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(FileRef(file, digest_file(file)),))}

    failure = run_flow(flow, store, scene="toy", reporter=Changing()).values["x"]
    assert isinstance(failure.error, InputError)
    assert "factor.txt, which has changed since the run started" in str(failure.error)
    file.write_text("2.0")
    os.utime(file, (1, 1))
    again = run_flow(flow, store, scene="toy")
    assert again.nodes[-1]["event"] == "finished" and float(store.get(again.values["x"]).value[0]) == 6.0


def test_a_file_that_is_another_one_only_while_it_is_read_fails_its_step(store, tmp_path, monkeypatch):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    read = Path.read_text

    def exchanged(path, *args, **options):
        if path != file:
            return read(path, *args, **options)
        file.write_text("5.00")
        content = read(file)
        file.write_text("2.0")
        os.utime(file, (1, 1))
        return content

    monkeypatch.setattr(Path, "read_text", exchanged)

    def flow():
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(FileRef(file, digest_file(file)),))}

    failure = run_flow(flow, store, scene="toy").values["x"]
    assert "factor.txt, which has changed since the run started" in str(failure.error)


def written_meanwhile(file, contents, digests=digest_file):
    """Digests of a file into which someone else writes each of these contents just after it was read."""
    left = iter(contents)

    def slow(path):
        digest = digests(path)
        if (content := next(left, None)) is not None:
            file.write_text(content)
            os.utime(file, (len(content), len(content)))
        return digest

    return slow


def test_a_file_that_changes_while_it_is_digested_is_digested_again(tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    ref = FileRef.of(file, written_meanwhile(file, ["2.00", "5.0"]))
    assert ref.digest == digest_file(file) and not ref.has_changed()
    with pytest.raises(InputError, match=r"factor.txt changes while it is read; run again when it is complete\."):
        FileRef.of(file, written_meanwhile(file, ["6.00", "7.0", "8.00"]))


def test_what_was_read_of_a_file_that_changed_meanwhile_is_not_remembered(tmp_path, monkeypatch):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    os.utime(file, (1, 1))
    digests = FileDigests(tmp_path / "files.json")
    with monkeypatch.context() as patched:
        patched.setattr(file_digests, "digest_file", written_meanwhile(file, ["5.00"], lambda path: "of both"))
        digests(file)
    file.write_text("2.0")
    os.utime(file, (1, 1))
    assert digests(file) == digest_file(file)


def test_a_file_that_was_only_touched_is_read_again_and_found_to_be_the_same(store, tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")

    def flow():
        ref = FileRef(file, digest_file(file))
        os.utime(file, (1, 1))
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(ref,))}

    assert run_flow(flow, store, scene="toy").failures == []


def test_a_link_to_a_file_that_is_made_while_it_is_used_changes_nothing(store, tmp_path, monkeypatch):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    read = Path.read_text

    def linked(path, *args, **options):
        if path == file:
            time.sleep(0.05)
            os.link(file, tmp_path / "copy of a backup")
        return read(path, *args, **options)

    monkeypatch.setattr(Path, "read_text", linked)
    ref = FileRef(file, digest_file(file))

    def flow():
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(ref,))}

    assert run_flow(flow, store, scene="toy").failures == [] and ref.stamp_now() != ref.stamp


def test_a_file_that_was_written_over_with_its_old_time_after_its_key_was_made_fails_its_step(store, tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    os.utime(file, (1, 1))

    def flow():
        ref = FileRef(file, digest_file(file))
        time.sleep(0.05)
        file.write_text("5.0")
        os.utime(file, (1, 1))
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(ref,))}

    failure = run_flow(flow, store, scene="toy").values["x"]
    assert "factor.txt, which has changed since the run started" in str(failure.error)
