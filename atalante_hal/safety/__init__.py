"""The safety core: what is wrong in a cycle, which state follows, and what may leave for the drives."""
