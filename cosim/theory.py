"""The condition on the gains that the paper publishes: μ_i > 1 + 2h*, for every agent that hears another.

It is evaluated and shown as published; it certifies nothing. Its proof takes 1/μ_i for the gain from ψ̃ + ε to η, while
a constant input d gives η = -d whatever λ is; and runs that violate it often still converge. Likewise h* here is the
largest age of information that a channel lets an agent read at a tick; Assumption 1 of the paper defines another,
larger number, the longest interval k*T + h between two useful messages.
"""

from __future__ import annotations

import math


def mu(k_eta: float, lambda_: float) -> float:
    """μ = -max(Re μ_1, Re μ_2) of the roots of x² + k_η x + λ = 0 (Theorem 2).

    Args:
        k_eta: gain k_η.
        lambda_: gain λ.
    """
    discriminant = k_eta * k_eta - 4.0 * lambda_
    if discriminant <= 0.0 or k_eta <= 0.0:
        return (k_eta - math.sqrt(max(discriminant, 0.0))) / 2.0
    return 2.0 * lambda_ / (k_eta + math.sqrt(discriminant))  # the smaller root without cancellation


def published_bound(mu_i: float) -> float:
    """(μ_i - 1)/2 in seconds: the published condition (eq. small_gain_condition01) asks that h* be less.

    Args:
        mu_i: in 1/s.
    """
    return (mu_i - 1.0) / 2.0
