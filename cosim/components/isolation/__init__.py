"""Components in processes of their own, for those that may crash, hang, or change what belongs to all of a process.

`component` stands in for one in the agent's process; `host` is the main program of the other process; `calls` is what
goes between them, over a pair of sockets: numbered batches of calls one way, their results the other. Nothing that
comes back is trusted further than its numbers.
"""

from __future__ import annotations

from cosim.components.isolation.component import IsolatedComponent

__all__ = ["IsolatedComponent"]
