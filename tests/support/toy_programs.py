"""Programs that run a toy flow, for tests to interrupt and to kill."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import ss_flow_toy as toy

PROGRAM = """
import sys
{before}
sys.path.insert(0, {support!r})
import ss_flow_toy as toy
from pathlib import Path
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
x = lambda: toy.source(values=(2.0,))[0]
run_flow(lambda: {{"out": {call}}}, Store(Path({store!r})), scene="toy", executor={executor!r})
"""


def start(store, call, executor="threads", before=""):
    support = str(Path(toy.__file__).parent)
    text = PROGRAM.format(support=support, call=call, store=str(store.root), executor=executor, before=before)
    return subprocess.Popen([sys.executable, "-c", text], stderr=subprocess.PIPE, text=True)


def claims(store):
    return [path.name for path in (store.root / "claims").iterdir()]
