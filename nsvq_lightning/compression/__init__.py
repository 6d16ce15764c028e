"""Fewer bytes, the same pictures."""
