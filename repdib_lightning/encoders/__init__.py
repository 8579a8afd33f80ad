"""Encoders: a dictionary of observations in, (N, M) out."""
