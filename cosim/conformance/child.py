"""The process in which a component is tried out: it may crash or hang there.

The request comes as one line of JSON at standard input, which stays open until the process is to end; what is found
goes, one line each, to what was standard output. The component's own prints go to standard error.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from cosim import scratch
from cosim.spawning import end_with_parent, leave


def main() -> None:
    """Carry out one request."""
    channel = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    request = json.loads(sys.stdin.readline())
    end_with_parent(scratch.remove_all)
    sys.path[:] = request["path"]

    def say(**what: Any) -> None:
        print(json.dumps(what), file=channel, flush=True)

    from cosim.components.component import Interface
    from cosim.components.opening import describe
    from cosim.conformance.checks import FIRST, findings
    from cosim.conformance.driving import Subject
    from cosim.conformance.report import Verdict
    from cosim.plan import ComponentPlan

    path = Path(request["file"]) if request["file"] else None
    start = {name: tuple(values) for name, values in request["start"].items()}
    structural = {name: values[0] for name, values in start.items() if values and isinstance(values[0], int)}
    description = describe(path, request["python"], structural)
    plan = ComponentPlan("component", path, request["python"], description, start)
    say(ready=True)
    hopeless: set[str] = set()
    for interface, name in request["checks"]:
        say(begins=[interface, name])
        found, ended = [(Verdict.SKIPPED, f"see {FIRST}")], True
        if interface not in hopeless:
            found, ended = findings(name, Subject(plan, Interface(interface)))
        if name == FIRST and not ended:
            hopeless.add(interface)
        for verdict, text in found:
            say(interface=interface, check=name, verdict=verdict, text=text)
        say(ends=[interface, name])


if __name__ == "__main__":
    main()
    leave(0)
