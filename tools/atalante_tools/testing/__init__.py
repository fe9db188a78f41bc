"""The pytest plugin: fixtures for tests on the emulated robot and on hardware."""
