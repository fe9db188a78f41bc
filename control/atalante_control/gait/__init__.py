"""Gaits, the subjects for which they are computed, and the re-centring of the joint trajectories at a stance change."""
