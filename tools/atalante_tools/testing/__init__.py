"""Pytest plugin with fixtures for tests on the emulated robot and on hardware."""
