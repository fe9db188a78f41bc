"""Exhaustive searches over all states that the safety functions can reach with any sequence of inputs, and the properties proved.

    functions of HAL and drive -> steps (hal_steps, drive_steps) -> breadth-first search (search) -> properties (explorations)
                                                                       counterexample -> scenario (replay)

The steps call the functions of the HAL and of the emulated drive themselves. They are no model of these functions.
"""
