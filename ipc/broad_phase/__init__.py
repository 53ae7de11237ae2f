"""Candidate pairs: primitives of two surfaces whose boxes overlap."""
