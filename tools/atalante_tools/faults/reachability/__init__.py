"""Exhaustive exploration of the safety functions: all states that any sequence of inputs can reach, and their properties.

    functions of HAL and drive -> steps (hal_steps, drive_steps) -> breadth-first search (search) -> properties (explorations)
                                                                       counterexample -> scenario (replay)

The steps call the functions of the HAL and of the emulated drive themselves. They are no model of these functions.
"""
