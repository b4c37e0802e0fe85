"""Looking on while it runs: terminal, browser, Foxglove. None of it is in the loop's process."""
