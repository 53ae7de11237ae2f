"""The time step: incremental potential, Newton's method, conjugate gradients, forces."""
