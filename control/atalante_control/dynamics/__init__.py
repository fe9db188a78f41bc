"""Dynamics of the exoskeleton: gravity, stance and suspension, and the network of gaits."""
