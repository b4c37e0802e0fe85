"""What a user of the benchmark can do wrong."""

from __future__ import annotations

from pamctl.exit_codes import ExitCode


class BenchmarkError(Exception):
    """The benchmark cannot go on. The message says where, why, and what to do."""

    exit_code = ExitCode.BAD_DATA
