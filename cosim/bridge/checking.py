"""Whether values from outside, live or recorded, can be what an input holds."""

from __future__ import annotations

import numpy as np

from cosim.components.component import Floats
from cosim.plan import Subscription
from network.payload import PayloadError


def fitting(subscription: Subscription, values: Floats) -> None:
    """Whether the inputs can hold values.

    Raises:
        PayloadError: they cannot.
    """
    if np.any(values < subscription.low) or np.any(values > subscription.high):
        raise PayloadError(f"it has a number that is not from {subscription.low:.9g} to {subscription.high:.9g}")
    if subscription.whole and np.any(values != np.floor(values)):
        raise PayloadError("it has a number that is not whole")
