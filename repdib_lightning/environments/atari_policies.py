"""Policies without learning: scripts that read the console's memory, so that data have games of every quality.

Mean returns by the share of random actions, of 5 games (10 where all are random, but 5 in Pong) of at most 27,000
emulator frames with a frame skip of 4 and no sticky actions:

========  =====  =====  =====  =====
game       0.02    0.1    0.3    1.0
========  =====  =====  =====  =====
Breakout    390     69     18    0.9
Pong       14.4    4.0  -14.6  -20.4
Qbert     7,155  6,130  4,115    145
Seaquest  2,880  2,028    948     80
========  =====  =====  =====  =====
"""

from __future__ import annotations

from repdib_lightning.environments.atari_paddles import BreakoutScript, PongScript
from repdib_lightning.environments.atari_qbert import QbertScript
from repdib_lightning.environments.atari_script import Script
from repdib_lightning.environments.atari_seaquest import SeaquestScript

SCRIPTS: dict[str, type[Script]] = {
    script.game: script for script in (BreakoutScript, PongScript, QbertScript, SeaquestScript)
}
"""Game -> its script."""
