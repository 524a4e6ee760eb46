"""What tells whether a learned representation has collapsed."""

from __future__ import annotations

import torch
from torch import Tensor


def effective_rank(features: Tensor) -> Tensor:
    """exp of the entropy of the normalised singular values (Roy and Vetterli 2007) around the mean: (E, B, D) -> (E,).

    Around the mean, since a common offset is one large singular value that says nothing of how points differ. Equal points have rank 1.
    """
    singular = torch.linalg.svdvals(features - features.mean(1, keepdim=True))
    share = singular / singular.sum(-1, keepdim=True).clamp(min=torch.finfo(singular.dtype).tiny)
    return torch.special.entr(share).sum(-1).exp()


def spread(features: Tensor) -> Tensor:
    """Root of the total variance over the minibatch: (E, B, D) -> (E,)."""
    return features.std(1).norm(dim=-1)


def action_share(state: Tensor, action: Tensor, neighbours: int) -> Tensor:
    """The actions' part (E,) of the squared distances between neighbours in the joint space, of 0 to 1.

    Args:
        state, action: (E, B, D) and (E, B, D'), side by side the points of the state-action entropy.
        neighbours: how many of each point's nearest ones count; the point itself, at distance 0, adds nothing.
    """
    parts = [torch.cdist(one, one).square() for one in (state, action)]
    nearest = (parts[0] + parts[1]).topk(neighbours, dim=-1, largest=False).indices
    of_state, of_action = (part.gather(2, nearest).sum((1, 2)) for part in parts)
    return of_action / (of_state + of_action).clamp(min=torch.finfo(of_state.dtype).tiny)
