"""Frozen encoder bundles: safetensors and JSON."""
