"""What tests install for themselves where they may: one at a time, as apt and npm want it."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_UNASKED = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}


@contextmanager
def alone() -> Iterator[None]:
    """Wait for all other workers that install something."""
    with Path(tempfile.gettempdir(), f"pamctl-tests-{os.getuid()}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def apt_install(*packages: str) -> None:
    """Try to install packages; the caller sees whether what it needs is there then."""
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        return
    # Somebody else's apt, outside the tests, is waited for too.
    options = ["-o", "DPkg::Lock::Timeout=300"]
    install = ["install", "-y", "--no-install-recommends", *packages]
    for command in (["update"], install):
        subprocess.run(
            ["apt-get", *options, *command],
            env=_UNASKED, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            check=False, timeout=600,
        )  # fmt: skip
