"""Errors of this package; each names the value, the rule and the choices."""

from __future__ import annotations


class IpcError(ValueError):
    """Input that breaks a rule of the solver."""


class OverlapError(IpcError):
    """Surfaces that touch or cross before the first step, or after a state was set by hand."""


class SolverError(RuntimeError):
    """A failure of the solver as a whole, such as a buffer that cannot grow."""
