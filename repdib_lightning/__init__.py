"""Representation learning with discrete information bottlenecks (RepDIB) on Lightning."""

__version__ = "0.1.0"
