"""`ss-flow view` from the command line."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import urllib.request

import pytest
from tiny_runs import SHORT, ss_flow


def test_without_the_extra_one_sentence_says_which_to_install(tiny, monkeypatch):
    monkeypatch.setattr("ss_flow.flows.cli.view.find_spec", lambda name: None)
    called = ss_flow("view", tiny.out)
    assert called.code == 2 and "pip install 'ss-flow[view]'" in called.err and called.err.count("\n") == 1


@pytest.mark.parametrize("option", ["--beside", "--script", "--correct"])
@pytest.mark.parametrize("form", ["--html", "--rerun"])
def test_what_only_the_viewer_takes_is_refused_for_a_file(tiny, tmp_path, form, option):
    called = ss_flow("view", tiny.out, form, tmp_path / "a", option, tiny.out)
    assert called.code == 2 and option in called.err and "are for the viewer, not for --html" in called.err
    assert not list(tmp_path.iterdir())


def test_without_rerun_no_page_is_written_either(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("ss_flow.flows.view.rerun_file.find_spec", lambda name: None)
    called = ss_flow("view", tiny.out, "--html", tmp_path / "a.html", "--rerun", tmp_path / "a.rrd")
    assert called.code == 2 and "pip install 'ss-flow[rerun]'" in called.err
    assert not list(tmp_path.iterdir())


def started(*arguments: object) -> tuple[subprocess.Popen[str], str, str]:
    """The command in a process of its own, and the two lines that it prints: the address, and where edits go."""
    code = "from ss_flow.flows.cli.main import entry; entry()"
    words = [str(argument) for argument in arguments]
    process = subprocess.Popen(
        [sys.executable, "-c", code, "view", *words, "--port", "0"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert process.stdout is not None
    return process, process.stdout.readline().strip(), process.stdout.readline()


def interrupted(*_: object) -> None:
    """Ctrl-C in the middle of what is done before it is waited for."""
    signal.raise_signal(signal.SIGINT)


class TestWithTheExtra:
    @pytest.fixture(autouse=True)
    def extra(self) -> None:
        pytest.importorskip("viser", reason="needs the extra `view`")

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            (("--port", "70000"), "--port 70000 is out of range; it must be from 0 to 65535."),
            (("--host", "no.such.host.invalid"), "the viewer cannot listen on no.such.host.invalid"),
            (("--host", "no..host"), "the viewer cannot listen on no..host, port 8080: there is no such host; choose"),
        ],
    )
    def test_where_it_cannot_listen_is_said(self, tiny, options, sentence):
        called = ss_flow("view", tiny.out, "--cache", tiny.store, *options)
        assert called.code == 2 and sentence in called.err

    def test_a_script_that_does_not_fit_the_run_is_refused(self, tiny, tmp_path):
        script = tmp_path / "s.json"
        script.write_text(json.dumps({"operations": [{"op": "remove", "instances": [999]}]}))
        called = ss_flow("view", tiny.out, "--cache", tiny.store, "--script", script)
        assert called.code == 2 and "operation 1 (remove): instances is [999]" in called.err

    def test_the_command_that_corrects_works_from_anywhere(self, tiny, tmp_path, monkeypatch):
        monkeypatch.setattr("ss_flow.flows.view.viewer.Viewer.load_pictures", interrupted)
        monkeypatch.chdir(tiny.out.parent)
        hints = tmp_path / "h.json"
        asked = ["--correct", os.path.relpath(hints), "--cache", tiny.store, "--port", "0"]
        called = ss_flow("view", tiny.out.name, *asked)
        run, scene, _, correct, *options = shlex.split(called.out.partition("made by: ")[2].rstrip(".\n"))[1:]
        assert (run, scene) == ("run", str(tiny.scene)), called
        assert os.path.isabs(correct) and os.path.samefile(os.path.dirname(correct), tmp_path)
        assert options == ["--preset", "fast", *SHORT, "--out", str(tiny.out), "--cache", str(tiny.store)]

    @pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
    def test_it_serves_until_it_is_interrupted_and_that_is_its_good_end(self, tiny, how):
        process, address, told = started(tiny.out, "--cache", tiny.store)
        with urllib.request.urlopen(address, timeout=60) as page:
            assert page.status == 200
        process.send_signal(how)
        _, err = process.communicate(timeout=60)
        assert process.returncode == 0 and not err and "saved in" in told
        assert not (tiny.out.parent / "out.edit.json").exists()

    def test_a_second_interrupt_ends_what_the_first_one_lets_go_on(self, tiny, monkeypatch):
        after: list[bool] = []

        def twice(_: object) -> None:
            signal.raise_signal(signal.SIGINT)
            after.append(True)
            signal.raise_signal(signal.SIGINT)
            after.append(False)

        monkeypatch.setattr("ss_flow.flows.view.viewer.Viewer.load_pictures", twice)
        before = signal.getsignal(signal.SIGINT)
        assert ss_flow("view", tiny.out, "--cache", tiny.store, "--port", "0").code == 0 and after == [True]
        assert signal.getsignal(signal.SIGINT) == before

    def test_an_edited_run_whose_source_changed_or_is_gone_says_so(self, warm, tmp_path, monkeypatch):
        monkeypatch.setattr("ss_flow.flows.view.viewer.Viewer.load_pictures", interrupted)
        script, edited = tmp_path / "s.json", tmp_path / "edited"
        script.write_text('{"operations": []}')
        assert ss_flow("edit", warm.out, script, "--out", edited, "--cache", warm.store).code == 0
        record = warm.out / "run.json"
        record.write_text(json.dumps(json.loads(record.read_text()) | {"content": "ab" * 32}))
        told = ss_flow("view", edited, "--cache", warm.store, "--port", "0")
        assert f"warning {edited} is an edit of {warm.out.resolve()}, which was run anew since" in told.out, told.err
        warm.out.rename(tmp_path / "elsewhere")
        refused = ss_flow("view", edited, "--cache", warm.store)
        assert refused.code == 2
        assert f"{edited} is an edited run, and its source, {warm.out.resolve()}, is not there" in refused.err

    def test_an_edited_run_is_gone_on_with(self, warm, tmp_path):
        script, edited = tmp_path / "s.json", tmp_path / "edited"
        script.write_text(json.dumps({"operations": [{"op": "remove", "instances": ["background"]}]}))
        assert ss_flow("edit", warm.out, script, "--out", edited, "--cache", warm.store).code == 0
        process, address, told = started(edited, "--cache", warm.store)
        assert address.startswith("http://127.0.0.1:") and "(1 so far)" in told
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
