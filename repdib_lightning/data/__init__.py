"""The store, its sampling and loading, and what reads foreign formats."""
