"""`python -m pamctl.benchmark`."""

from pamctl.benchmark.rigs_folder import call_in_rigs
from pamctl.realtime.scheduling import keep_single_threaded

if __name__ == "__main__":
    keep_single_threaded()
    call_in_rigs("hidden.benchmark.command_line", "main")
