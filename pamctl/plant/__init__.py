"""The paper's model of the muscle: two blocks, and the catalogue of effects on top."""
