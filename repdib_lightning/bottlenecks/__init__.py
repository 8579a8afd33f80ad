"""Bottlenecks: the slot between an encoder and an objective."""
