"""Environments: where data sets come from."""
