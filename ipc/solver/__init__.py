"""The time step: incremental potential, Newton's method, conjugate gradients, and forces of a solved step."""
