"""The Decision Transformer's network: returns-to-go, states and actions in, logits of actions out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from repdib_lightning.rl.decision_transformer.attention import CausalAttention
from repdib_lightning.rl.decision_transformer.cache import LayerCache
from repdib_lightning.rl.decision_transformer.dropout import Dropout

RETURN_RANGE = 50.0
"""What the largest return-to-go of the data counts as. Weights start with a deviation of 0.02, so its embedding begins
as tanh of numbers of deviation 1: returns stay apart. The published program starts these weights evenly in (-1, 1) and
takes returns as they are: of 20 on, in any game, tanh is saturated for most of them."""

TOKENS = 3
"""Of a step: return-to-go, state, action."""


@dataclass(frozen=True)
class Sizes:
    """Attributes: actions: A. context: T, steps of a window. stride: steps between the beginnings of two windows of an
    episode, and beginnings: how many there are in the longest one, in training. layers, heads, width, dropout: of the
    transformer. return_scale: returns-to-go are divided by it."""

    actions: int
    context: int
    stride: int
    beginnings: int
    layers: int
    heads: int
    width: int
    dropout: float
    return_scale: float


class DecisionTransformer(nn.Module):
    """A causal transformer over (return-to-go, state, action) of each step (Chen et al. 2021, section 3 and Atari).

    Embeddings of returns, states and actions end in tanh. To each token are added a learned embedding of its place in
    the window and one of the time step at which the window begins; of a window that begins where none did in training,
    that of the last beginning before it. The logits are read at the state tokens. A token
    sees itself and what is before it, so what stands behind an episode's end changes nothing before it.

    Args:
        sizes: of everything.
        states: what is seen of a step to its embedding, (B, T, ...) to (B, T, width).
    """

    def __init__(self, sizes: Sizes, states: nn.Module) -> None:
        super().__init__()
        self.sizes = sizes
        width = sizes.width
        self.returns = nn.Linear(1, width)
        self.actions = nn.Embedding(sizes.actions, width)
        self.beginnings = nn.Embedding(sizes.beginnings, width)
        self.positions = nn.Parameter(torch.zeros(TOKENS * sizes.context, width))
        self.dropout = Dropout(sizes.dropout)
        self.blocks = nn.ModuleList(Block(sizes) for _ in range(sizes.layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, sizes.actions, bias=False)
        self.apply(initialise)
        nn.init.zeros_(self.beginnings.weight)
        self.states = states  # whose own start stays

    def forward(self, states: Tensor, returns: Tensor, actions: Tensor, first: Tensor) -> Tensor:
        """Logits of the actions of whole windows.

        Args:
            states: (B, T, ...). returns: (B, T), to go. actions: (B, T) int64. first: (B,) int64, time step at which
                each window begins.

        Returns:
            (B, T, A); that of step t hangs on nothing behind the state of t.
        """
        steps = [self.embed_returns(returns), self.states(states), self.embed_actions(actions)]
        tokens = torch.stack(steps, dim=2).flatten(1, 2)
        return self.read(tokens, first, slice(1, None, TOKENS))

    def embed_returns(self, returns: Tensor) -> Tensor:
        """(...,) to (..., width)."""
        return torch.tanh(self.returns(returns.unsqueeze(-1) / self.sizes.return_scale))

    def embed_actions(self, actions: Tensor) -> Tensor:
        """(...,) int64 to (..., width)."""
        return torch.tanh(self.actions(actions))

    def read(self, tokens: Tensor, first: Tensor, wanted: slice, caches: list[LayerCache] | None = None) -> Tensor:
        """Run embedded tokens through the blocks.

        Args:
            tokens: (B, n, width). first: (B,) int64, time step of the window's first step. wanted: which m of them are
                asked for; in the last block there is no more to do for the others than that they can be seen. caches:
                of each block, of the tokens before; these are added.

        Returns:
            logits (B, m, A).
        """
        start = 0 if caches is None else caches[0].length
        places = self.positions[start : start + tokens.shape[1]]
        began = (first // self.sizes.stride).clamp(max=self.sizes.beginnings - 1)
        hidden = self.dropout(tokens + places + self.beginnings(began).unsqueeze(1))
        for number, block in enumerate(self.blocks, 1):
            cache = None if caches is None else caches[number - 1]
            hidden = block(hidden, cache, wanted if number == len(self.blocks) else None)
        logits: Tensor = self.head(self.norm(hidden))
        return logits


class Block(nn.Module):
    """Attention and a perceptron, each on normalised inputs and added to what came in (GPT-2)."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        width = sizes.width
        self.norm_attention, self.norm_perceptron = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = CausalAttention(width, sizes.heads, sizes.dropout)
        self.perceptron = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width), Dropout(sizes.dropout)
        )

    def forward(self, hidden: Tensor, cache: LayerCache | None = None, wanted: slice | None = None) -> Tensor:
        """(B, n, width) to the m wanted of these tokens, (B, m, width); all by default."""
        attended = self.attention(self.norm_attention(hidden), cache, wanted)
        hidden = attended + (hidden if wanted is None else hidden[:, wanted])
        added: Tensor = hidden + self.perceptron(self.norm_perceptron(hidden))
        return added


def initialise(module: nn.Module) -> None:
    """GPT's start: normal weights of deviation 0.02, zero biases."""
    if isinstance(module, (nn.Linear, nn.Embedding)):
        nn.init.normal_(module.weight, std=0.02)
    if isinstance(module, nn.Linear) and module.bias is not None:
        nn.init.zeros_(module.bias)
