"""A PC that sleeps, for processes of one run: they stand still, and CLOCK_MONOTONIC with them."""

from __future__ import annotations

import mmap
import os
import signal
import struct
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path

_SOURCE = r"""
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
#include <errno.h>
static volatile int64_t *shift_ns;
__attribute__((constructor)) static void attach(void) {
    int fd = open(getenv("SLEPT_FILE"), O_RDONLY);
    shift_ns = mmap(0, 8, PROT_READ, MAP_SHARED, fd, 0);
    close(fd);
}
static void add(struct timespec *t, int64_t ns) {
    int64_t sum = t->tv_sec * 1000000000LL + t->tv_nsec + ns;
    t->tv_sec = sum / 1000000000LL;
    t->tv_nsec = sum % 1000000000LL;
}
int clock_gettime(clockid_t clock, struct timespec *t) {
    int failed;
    int64_t shifted_ns;
    do {  /* again, if the sleep came between the two */
        shifted_ns = *shift_ns;
        failed = syscall(SYS_clock_gettime, clock, t);
    } while (shifted_ns != *shift_ns);
    if (!failed && clock == CLOCK_MONOTONIC) add(t, -shifted_ns);
    return failed;
}
int clock_nanosleep(clockid_t clock, int flags, const struct timespec *until,
                    struct timespec *left) {
    struct timespec t = *until;
    if (clock == CLOCK_MONOTONIC && flags & TIMER_ABSTIME) add(&t, *shift_ns);
    return syscall(SYS_clock_nanosleep, clock, flags, &t, left) ? errno : 0;
}
"""


class SleepingPc:
    """The library to start processes with, and the sleep itself."""

    def __init__(self, folder: Path) -> None:
        """Build the library in `folder`; the PC has not slept yet."""
        self._file = folder / "slept"
        self._file.write_bytes(bytes(mmap.PAGESIZE))
        self._library = folder / "sleeping.so"
        source = folder / "sleeping.c"
        source.write_text(_SOURCE)
        subprocess.run(["gcc", "-shared", "-fPIC", "-o", self._library, source], check=True)

    @property
    def environment(self) -> dict[str, str]:
        """What processes that sleep with the PC have in their environment."""
        return {"LD_PRELOAD": str(self._library), "SLEPT_FILE": str(self._file)}

    def sleep(self, pids: Iterable[int], seconds: float) -> None:
        """Let the processes sleep for so long."""
        pids = list(pids)
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        with self._file.open("r+b") as file:
            file.write(struct.pack("<q", round(seconds * 1e9)))
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
