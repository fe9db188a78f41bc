"""Gait optimization: partial hybrid zero dynamics as one nonlinear program for each step.

`links -> symbolic dynamics (CasADi) -> step problem (NLP, built once) -> solve (IPOPT) -> Gait`. `verify` checks the gait
independently with Pinocchio. This package does not run on the robot, and no other package imports CasADi (extra `gaits`).
"""
