"""Driving by hand, in a notebook."""
