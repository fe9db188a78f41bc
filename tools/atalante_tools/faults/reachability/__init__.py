"""Exhaustive searches that prove safety properties in all states which any sequence of inputs can reach.

    functions of HAL and drive -> steps (hal_steps, drive_steps) -> breadth-first search (search) -> properties (explorations)
                                                                       counterexample -> scenario (replay)

The steps call the real functions of the HAL and of the emulated drive, not a model of these functions.
"""
