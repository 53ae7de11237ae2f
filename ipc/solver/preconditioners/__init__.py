"""Preconditioners of the conjugate gradients."""
