"""Gait optimization: a nonlinear program computes the joint trajectories of each step.

The literature calls this method partial hybrid zero dynamics.

`links -> symbolic dynamics (CasADi) -> step problem (NLP, built once) -> solve (IPOPT) -> Gait`. `verify` checks the gait
independently with Pinocchio. This package does not run on the robot. No other package imports CasADi. The pip extra
`gaits` installs CasADi.
"""
