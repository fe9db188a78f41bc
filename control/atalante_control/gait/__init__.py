"""Gaits, subjects (patient and step parameters), and re-centring of the joint trajectories at a stance change."""
