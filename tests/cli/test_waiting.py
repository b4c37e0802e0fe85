"""A verb that is silent for seconds says on a terminal what it does; elsewhere it says nothing."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

SLOW = """
import time, sys
from pamctl.cli import failure, verbs
verbs.SLOW_VERBS["doze"] = "doze: dozing"
def doze():
    time.sleep(1.5)
    print("done")
failure.print_plainly(doze, "doze")()
"""


def test_a_silent_verb_says_what_it_does_until_it_prints() -> None:
    ours, its = pty.openpty()
    done = subprocess.run([sys.executable, "-c", SLOW], stdout=its, stderr=its, timeout=60)
    assert done.returncode == 0
    seen = os.read(ours, 65536).decode()
    os.close(ours)
    os.close(its)
    assert re.fullmatch(r"(\r\x1b\[Kdoze: dozing, \d+ s)+\r\x1b\[Kdone\r\n", seen)


def test_a_verb_whose_code_is_new_says_that_it_is_compiled() -> None:
    code = SLOW.replace(
        "def doze", "import pamctl.kernel.build as b\nb.progress.builds = True\ndef doze"
    )
    ours, its = pty.openpty()
    subprocess.run([sys.executable, "-c", code], stdout=its, stderr=its, timeout=60, check=True)
    seen = os.read(ours, 65536).decode()
    os.close(ours)
    os.close(its)
    assert "doze: dozing (the first time after an update the model is compiled), " in seen


def test_without_a_terminal_nothing_is_shown() -> None:
    done = subprocess.run([sys.executable, "-c", SLOW], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("done\n", "")
