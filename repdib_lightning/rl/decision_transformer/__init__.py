"""The Decision Transformer on discrete actions (Chen et al. 2021): on latents of a frozen encoder, or end to end."""
