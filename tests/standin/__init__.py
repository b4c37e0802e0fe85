"""A PCI-6221 that is not there: driver, card and muscle, for tests."""
