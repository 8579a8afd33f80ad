"""Reward-free exploration: an agent that is paid for reaching what is far from what it has seen."""
