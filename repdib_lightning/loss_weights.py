"""What each named loss of a bottleneck or an objective weighs, unless ``loss_weights`` says otherwise."""

DEFAULT_LOSS_WEIGHTS = {
    "kl": 0.01,
    "commitment": 0.25,
    "information": 1e-4,
    "forward": 0.1,
    "emi_error": 100.0,
    "emi_information": 0.1,
    "emi_action_kl": 0.5,
    "db_kl": 0.01,
    "db_prediction": 0.01,
    "db_contrast": 0.01,
}
DEFAULT_LOSS_WEIGHTS |= {f"unimodal_{name}": DEFAULT_LOSS_WEIGHTS[name] for name in ("kl", "commitment", "information")}
"""Weight of each named loss term; every other term weighs 1.

``kl``: VIB coefficient of the paper, in all three tables. ``commitment``: VQ-VAE.

``information`` (SVIB): published nowhere. A nat costs what it costs the VIB, whose 0.01 weighs the mean over 128
dimensions. From 0.001 on, multi-step inverse dynamics in the mazes never starts: the latents become constant.

``forward``: ours, an auxiliary that must not outweigh its objective.

``emi_*``: the published program's for pixels (Atari); for states it has 1e4, 0.05 and 0.1.

``db_*``: a tenth of the published program's, whose terms stand alone (0.1 each; by game down to 0.001 for ``db_kl`` and
0.01 for ``db_contrast``). At those, multi-step inverse dynamics beside them never starts in the mazes.

``unimodal_*``: a bottleneck inside an encoder costs, in the mean over its modalities, what the one behind it costs.
"""
