"""Gaits, the subjects of the gaits, and the re-centring of the joint trajectories at a stance change."""
