"""Gait generation: partial hybrid zero dynamics as one nonlinear program a step.

`links -> symbolic dynamics (CasADi) -> step problem (NLP, built once) -> solve (IPOPT) -> Gait`, and `verify` judges the gait
with Pinocchio alone. Nothing here runs on the robot, and nothing outside this package imports CasADi (extra `gaits`).
"""
