"""Exhaustive searches that prove safety properties in every reachable state, for all sequences of inputs.

    functions of HAL and drive -> steps (hal_steps, drive_steps) -> breadth-first search (search) -> properties (explorations)
                                                                       counterexample -> scenario (replay)

The steps call the real functions of the HAL and of the emulated drive, not a model of these functions.
"""
