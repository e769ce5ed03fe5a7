"""The small mixture density network of notebook 03: a density of one number, given another."""

import torch

from stad_lab.models.mdn_rnn import Mixture, mdn_loss


def answer(network: torch.nn.Module, x: torch.Tensor, mixtures: int) -> Mixture:
    """The density of y that a network gives for x, (n, 1, 1): parts (n, 1, 1, mixtures)."""
    numbers = network(8 * (x - 0.5)).view(len(x), 1, 3, 1, mixtures)
    logits, mean, logsigma = numbers.unbind(2)
    return Mixture(logits.log_softmax(-1), mean, logsigma.clamp(-5, 3))


def fit_density(
    x: torch.Tensor, y: torch.Tensor, mixtures: int, steps: int = 1000
) -> torch.nn.Module:
    """A network trained to give the density of y for x, (n, 1, 1) each, with so many Gaussians."""
    head = torch.nn.Linear(32, 3 * mixtures)
    head.bias.data[mixtures : 2 * mixtures] = torch.linspace(0, 1, mixtures)
    network = torch.nn.Sequential(torch.nn.Linear(1, 32), torch.nn.Tanh(), head)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
    slower = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        mdn_loss(answer(network, x, mixtures), y).backward()
        optimizer.step()
        slower.step()
    return network.requires_grad_(False)
