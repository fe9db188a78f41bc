"""Pytest plugin with fixtures for tests on an emulated or real robot."""
