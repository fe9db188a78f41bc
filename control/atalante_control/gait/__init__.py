"""Gaits, the subjects they are made for, and the re-centring at a step change."""
