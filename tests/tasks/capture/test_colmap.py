"""COLMAP's library beside what Python has set."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import os, signal, threading, time
from ss_flow.tasks.capture.colmap import load_pycolmap
signal.signal(signal.SIGTERM, signal.default_int_handler)
thread = threading.Thread(target=load_pycolmap)
thread.start()
thread.join()
try:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(10)
except KeyboardInterrupt:
    print("stopped", load_pycolmap().__name__)
"""


def test_sigterm_stops_a_run_as_before_once_the_library_is_loaded():
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120, check=True)
    assert (ended.stdout.split(), ended.stderr) == (["stopped", "pycolmap"], "")
